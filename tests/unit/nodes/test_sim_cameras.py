"""Slow drawing gets coarser until it keeps up, and finer again when it is easy."""

from __future__ import annotations

import pytest

from vla_zenoh.nodes.camera.node import COARSEST, RenderBudget

RATE_HZ = 30.0


def settle(coarseness: RenderBudget, full_s: float, pictures: int = 200) -> int:
    """Draw with a cost proportional to the pixels drawn."""
    for _ in range(pictures):
        coarseness.add(full_s / coarseness.step**2)
    return coarseness.step


@pytest.mark.parametrize(
    ("full_s", "step"), [(0.004, 1), (0.040, 2), (0.100, 3), (0.200, 4), (5.0, COARSEST)]
)
def test_drawing_gets_as_coarse_as_keeping_up_needs(full_s: float, step: int) -> None:
    assert settle(RenderBudget(RATE_HZ), full_s) == step


def test_it_gets_fine_again_when_the_computer_is_free() -> None:
    coarseness = RenderBudget(RATE_HZ)
    assert settle(coarseness, 0.2) > 1
    assert settle(coarseness, 0.003) == 1


def test_it_does_not_swing_between_two_steps() -> None:
    coarseness = RenderBudget(RATE_HZ)
    settle(coarseness, 0.040)
    seen = {coarseness.step}
    for _ in range(300):
        coarseness.add(0.040 / coarseness.step**2)
        seen.add(coarseness.step)
    assert len(seen) == 1
