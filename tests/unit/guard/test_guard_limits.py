"""What a robot is given keeps the limits as it sees them: as differences of positions alone.

The streams are jerk-limited, as a command node's are, and what is between loses, delays, reorders
and heaps them.
"""

from __future__ import annotations

import random
from functools import cache

import numpy as np
import pytest
from guard_rig import (
    CLEAN,
    STREAM_S,
    Link,
    Mode,
    Trace,
    drive,
    ill,
    limits_of,
    magnitudes,
    ratios,
)

from vla_zenoh.guard.reference_governor import BRAKE_MARGIN, ORDINARY

TICKS_S = [STREAM_S, 0.001]
"""An arm of one's own and a ROS 2 controller, and the simulator's law."""
DURATION_S = 4.0
TURNED = 1.1
"""What turns is planned axis by axis, which adds so much to its jerk in space."""
MOVING = 1.04
"""Velocity and acceleration of what is told may grow in the tick in which that is noticed."""
FR3 = {
    "pose": np.array([[1.7, 1.7, 1.7, 2.5], [13, 13, 13, 25], [6500, 6500, 6500, 12500]]),
    "joint": np.array(
        [
            [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
            [15, 7.5, 10, 12.5, 15, 20, 20],
            [7500, 3750, 5000, 6250, 7500, 10000, 10000],
        ]
    ),
}
"""Velocity, acceleration and jerk at which the Franka Control Interface ends a motion: per axis of
the TCP and norm of its rotation (FR3), and per joint (Panda). Source: frankarobotics.github.io,
"Robot and interface specifications"."""


@cache
def over_an_ill_link(mode: Mode, seed: int, tick_s: float) -> Trace:
    """Driven once for all that is asked of it."""
    return drive(mode, seed, ill(random.Random(seed)), tick_s=tick_s, duration_s=DURATION_S)


@pytest.mark.parametrize("tick_s", TICKS_S)
@pytest.mark.parametrize("mode", ["pose", "joint"])
@pytest.mark.parametrize("seed", [1, 3])
def test_over_whatever_link_every_difference_keeps_to_the_margin(
    mode: Mode, seed: int, tick_s: float
) -> None:
    velocity, acceleration, jerk = ratios(mode, over_an_ill_link(mode, seed, tick_s))
    assert velocity <= BRAKE_MARGIN * MOVING
    assert acceleration <= BRAKE_MARGIN * MOVING
    assert jerk <= BRAKE_MARGIN * TURNED


@pytest.mark.parametrize("tick_s", TICKS_S)
@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_what_is_told_beside_a_position_is_what_the_positions_do(mode: Mode, tick_s: float) -> None:
    trace = over_an_ill_link(mode, 3, tick_s)
    velocity, acceleration, _ = trace.differences()
    limits = limits_of(mode)
    mean = (trace.rate[1:] + trace.rate[:-1]) / 2
    # As near as two ticks of the greatest jerk there is leave it.
    off = magnitudes(mode, velocity[1:] - mean)
    assert (off <= BRAKE_MARGIN * limits[2] * tick_s**2).all()
    off = magnitudes(mode, acceleration - trace.change[:-1])
    assert (off <= BRAKE_MARGIN * limits[2] * tick_s).all()


@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_a_healthy_stream_has_no_more_than_its_own_limits(mode: Mode) -> None:
    trace = drive(mode, 1, CLEAN, tick_s=STREAM_S, duration_s=DURATION_S, aside=False)
    assert (ratios(mode, trace) <= ORDINARY).all()
    assert trace.refused == 0
    assert trace.silences == 0


@pytest.mark.parametrize("mode", ["pose", "joint"])
@pytest.mark.parametrize("seed", [1, 3])
def test_at_a_thousand_hertz_no_limit_of_a_real_franka_is_met(mode: Mode, seed: int) -> None:
    trace = over_an_ill_link(mode, seed, 0.001)
    for values, limit in zip(trace.differences(), FR3[mode], strict=True):
        assert (magnitudes(mode, values) < limit).all()


@pytest.mark.parametrize("mode", ["pose", "joint"])
def test_over_a_wireless_link_the_arm_stays_near_what_was_told(mode: Mode) -> None:
    link = Link(loss=0.02, delay_s=0.02, holdup_s=0.05, holdups=0.002, twice=0.1)
    apart: list[float] = []

    def note(guard: object, record: object) -> None:
        apart.append(_apart(guard, record))

    drive(mode, 5, link, tick_s=STREAM_S, duration_s=DURATION_S, each=note)
    assert np.percentile(apart, 50) < 0.001
    assert np.percentile(apart, 99) < (0.01 if mode == "pose" else 0.03)


def _apart(guard: object, record: object) -> float:
    """From what the writer says at that time: m, or rad of the joint that is furthest away."""
    if record is None or not guard.following:  # type: ignore[attr-defined]
        return 0.0
    if hasattr(record, "position_rad"):
        here = guard.motion.position_rad  # type: ignore[attr-defined]
        return float(np.abs(here - record.position_rad).max())  # type: ignore[attr-defined]
    here = guard.motion.pose.position_m  # type: ignore[attr-defined]
    return float(np.linalg.norm(here - record.position_m))  # type: ignore[attr-defined]
