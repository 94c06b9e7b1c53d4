"""The trim of a Franka arm's set-points, on a spring with dry friction."""

from __future__ import annotations

import numpy as np
import pytest
from vla_zenoh_franka.arm import MOST_JOINT_RAD, MOST_M, MOST_RAD, Trim

DT_S, TRIM_EVERY = 1e-3, 4
STIFFNESS, DAMPING, MASS = 2000.0, 90.0, 5.0
WAY_M, MOVES_S, SETTLES_S = 0.04, 1.0, 3.0


def left_after_a_motion(friction_n: float, trim: Trim | None) -> float:
    """How far (m) from its goal a sprung mass stands after it was led along x."""
    position = speed = 0.0
    added = np.zeros(6)
    for step in range(int((MOVES_S + SETTLES_S) / DT_S)):
        share = min(1.0, step * DT_S / MOVES_S)
        goal = WAY_M * share**3 * (10 - 15 * share + 6 * share**2)
        if trim is not None and step % TRIM_EVERY == 0:
            left = np.array([goal - position, 0, 0, 0, 0, 0])
            added = trim.update(left, TRIM_EVERY * DT_S)
        force = STIFFNESS * (goal + added[0] - position) - DAMPING * speed
        speed += force / MASS * DT_S
        slowed = friction_n / MASS * DT_S
        speed = 0.0 if abs(speed) <= slowed else speed - np.copysign(slowed, speed)
        position += speed * DT_S
    return abs(WAY_M - position)


@pytest.mark.parametrize("friction_n", [2.0, 5.0, 9.0])
def test_what_friction_leaves_is_trimmed_away(friction_n: float) -> None:
    assert left_after_a_motion(friction_n, None) > 7e-4
    assert left_after_a_motion(friction_n, Trim(6)) < 5e-4


def test_an_arm_that_is_held_is_pushed_no_harder_than_by_the_bounds() -> None:
    trim = Trim(6)
    for _ in range(5000):
        added = trim.update(np.array([0.02, -0.03, 0.04, 0.1, 0.2, -0.1]), 0.004)
    assert np.linalg.norm(added[:3]) == pytest.approx(MOST_M)
    assert np.linalg.norm(added[3:]) == pytest.approx(MOST_RAD)


def test_joints_are_bounded_one_by_one() -> None:
    trim = Trim(7)
    for _ in range(5000):
        added = trim.update(np.array([0.1, 0, 0, 0, 0, 0, -0.2]), 0.004)
    np.testing.assert_allclose(added, [MOST_JOINT_RAD, 0, 0, 0, 0, 0, -MOST_JOINT_RAD])
