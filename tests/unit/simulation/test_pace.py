"""A simulated world on computers of any speed, on a clock of the test."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from vla_zenoh.simulation.pace import (
    CONTROL_STEPS,
    GIVE_UP_NS,
    MAX_STEPS,
    MAX_STRETCH,
    SLIP_AFTER_NS,
    SLIP_NS,
    STEP_NS,
    STRETCH_PER_STEP,
    Pace,
    PacedTick,
    control_steps,
)

MS_NS = 1_000_000


def run(
    cost_ns: Callable[[PacedTick], int], ticks: int, steps: int = CONTROL_STEPS
) -> tuple[Pace, list[PacedTick], int]:
    """Ticks of a computer that needs `cost_ns` for each, and the time when they are over."""
    pace, now_ns, found = Pace(0, steps), 0, list[PacedTick]()
    for _ in range(ticks):
        tick = pace.next(now_ns)
        now_ns += max(tick.wait_ns, 0) + cost_ns(tick)
        found.append(tick)
    return pace, found, now_ns


@pytest.mark.parametrize("steps", [CONTROL_STEPS, MAX_STEPS])
def test_on_a_computer_that_keeps_up_simulated_time_is_real_time(steps: int) -> None:
    pace, ticks, _ = run(lambda _: MS_NS, 1500, steps)
    assert {(tick.steps, tick.stretch, tick.given_up_ns) for tick in ticks} == {(steps, 1.0, 0)}
    assert pace.factor == 1.0


@pytest.mark.parametrize(
    ("rate_hz", "steps"), [(1000.0, 2), (250.0, 2), (200.0, 2), (125.0, 4), (100.0, 4), (20.0, 4)]
)
def test_control_is_computed_twice_a_command_and_not_more_rarely_than_on_a_slow_computer(
    rate_hz: float, steps: int
) -> None:
    assert control_steps(rate_hz) == steps


def test_a_computer_that_is_too_slow_for_the_controllers_computes_them_less_often() -> None:
    control_ns, step_ns = 3 * MS_NS, MS_NS // 10  # 3.2 ms for a tick of 2 ms
    pace, ticks, _ = run(lambda tick: control_ns + tick.steps * step_ns, 1500)
    assert pace.factor == pytest.approx(1.0, abs=0.01)
    assert max(tick.stretch for tick in ticks) == 1.0
    assert max(tick.steps for tick in ticks) <= MAX_STEPS


@pytest.mark.parametrize(
    ("factor", "steps"),
    [(0.8, CONTROL_STEPS), (0.6, CONTROL_STEPS), (0.4, CONTROL_STEPS), (0.6, MAX_STEPS)],
)
def test_on_a_slower_computer_time_slips_evenly_and_nothing_is_given_up(
    factor: float, steps: int
) -> None:
    pace, ticks, end_ns = run(lambda tick: round(tick.steps * STEP_NS / factor), 2000, steps)
    assert pace.factor == pytest.approx(factor, rel=0.05)
    assert not any(tick.given_up_ns for tick in ticks)
    latest_ns = SLIP_AFTER_NS + (1 / factor - 1) * SLIP_NS
    assert end_ns - ticks[-1].time_ns < latest_ns + 2 * MAX_STEPS * STEP_NS / factor
    later = [tick.stretch for tick in ticks[500:]]
    assert max(later) - min(later) < 0.1


@pytest.mark.parametrize("pause_ms", [5, 30, 60, 95, 130, 2000])
def test_after_a_pause_the_ticks_meet_real_time_again(pause_ms: int) -> None:
    costs_ns = {100: pause_ms * MS_NS}
    asked = iter(range(10_000))
    _, ticks, end_ns = run(lambda _: costs_ns.get(next(asked), MS_NS // 2), 600)
    assert abs(end_ns - ticks[-1].time_ns) < 3 * MS_NS
    given_up_ns = sum(tick.given_up_ns for tick in ticks)
    assert (given_up_ns > 0) == (pause_ms * MS_NS > GIVE_UP_NS)
    elapsed_ns = [later.time_ns - tick.time_ns for tick, later in pairwise(ticks)]
    for tick, ns in zip(ticks[1:], elapsed_ns, strict=True):
        assert ns == round(tick.period_s * 1e9) + tick.given_up_ns


def test_the_stretch_changes_slowly_and_is_bounded() -> None:
    asked = iter(range(10_000))
    _, ticks, _ = run(lambda _: (90 if next(asked) % 20 == 0 else 1) * MS_NS, 2000)
    for before, tick in pairwise(ticks):
        assert abs(tick.stretch - before.stretch) <= STRETCH_PER_STEP * tick.steps + 1e-6
        assert 1.0 <= tick.stretch <= MAX_STRETCH
