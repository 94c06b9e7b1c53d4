"""A difference between what was foretold and what is told comes in without a step."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.control.correction import STIFFNESS_1_S, Correction
from vla_zenoh.control.reference import GuardLimits, ReferenceGuard
from vla_zenoh.control.smoothing import MotionLimits
from vla_zenoh.control.so3 import Pose
from vla_zenoh.types import Header, PoseCommand, Stamped

DT_S = 1e-3
GONE_M = 1e-4
WHOLE_S = 0.6
SPEED_M_S = 0.2
TICK_NS = 1_000_000
STEP_SLACK_M = 2e-4


@given(st.integers(1, 300), st.floats(-0.02, 0.02), st.floats(-0.2, 0.2))
def test_value_and_rate_change_continuously_from_what_it_began_with(
    ticks: int, value: float, rate: float
) -> None:
    correction = Correction(1, DT_S)
    correction.begin(np.array([value]), np.array([rate]))
    assert correction.now is not None
    assert (correction.now.value[0], correction.now.rate[0]) == (value, rate)
    for _ in range(ticks):
        now = correction.now
        correction.tick()
        if now is None or correction.now is None:
            continue
        moved = correction.now.value - now.value
        mean = (correction.now.rate + now.rate) * (DT_S / 2)
        np.testing.assert_allclose(moved, mean, atol=1e-6)


def test_twenty_millimetres_are_gone_soon_and_never_in_haste() -> None:
    correction = Correction(3, DT_S)
    correction.begin(np.array([0.02, 0.0, 0.0]), np.zeros(3))
    fastest = 0.0
    for _ in range(round(WHOLE_S / DT_S)):
        assert correction.now is not None
        fastest = max(fastest, float(np.abs(correction.now.change).max()))
        correction.tick()
    assert fastest <= STIFFNESS_1_S**2 * 0.02 * 1.001
    assert correction.now is None or float(np.abs(correction.now.value).max()) < GONE_M


def test_nothing_to_correct_stays_nothing() -> None:
    correction = Correction(6, DT_S)
    correction.tick()
    assert correction.now is None


def test_a_stream_that_stood_still_for_a_moment_does_not_pull_the_reference_back() -> None:
    start = Pose(np.array([0.4, 0.0, 0.3]), np.eye(3))
    limits = GuardLimits(0.1, MotionLimits((1.0, 4.0, 40.0), (3.0, 12.0, 120.0)))
    guard = ReferenceGuard(start, DT_S, limits)
    now_ns, sent, way_m, positions = 10**18, 0, 0.0, []
    for tick in range(1000):
        now_ns += TICK_NS
        # The writer stalls for 60 ms and then goes on where it was, not where it should be.
        if tick % 4 == 0 and not 300 <= tick < 360:
            speed_m_s = min(SPEED_M_S * sent / 25, SPEED_M_S)
            way_m += speed_m_s * 0.004
            record = PoseCommand(
                start.position_m + [way_m, 0.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                [speed_m_s, 0, 0, 0, 0, 0],
                np.zeros(6),
                start.position_m,
                [0.0, 0.0, 0.0, 1.0],
                "active",
            )
            sent += 1
            assert guard.offer(Stamped(Header(now_ns, sent, "c"), record, now_ns), now_ns) is None
        positions.append(guard.tick(now_ns).pose.position_m[0])
    steps = np.diff(positions)[150:]
    assert float(np.abs(steps - SPEED_M_S * DT_S).max()) < STEP_SLACK_M
    assert abs(positions[-1] - (start.position_m[0] + way_m)) < 2 * SPEED_M_S * 0.004
