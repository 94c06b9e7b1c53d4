"""A step of what is told does not become one of the reference: it goes over, within its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.limits import MotionLimits
from vla_zenoh.control.smoothing import Motion
from vla_zenoh.guard.reference_governor import (
    BRAKE_MARGIN,
    GovernorLimits,
    JointSpace,
    PoseSpace,
    ReferenceGovernor,
)
from vla_zenoh.guard.stream_guard import ACCELERATE_S, Extrapolation, PoseGuard
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3
from vla_zenoh.types import FloatArray, Header, JointReference, PoseCommand, Stamped

DT_S = 1e-3
SOON_S = 0.6
SPEED_M_S = 0.2
TICK_NS = 1_000_000
STEP_SLACK_M = 2e-4
OWN = np.array([0.5, 2.0, 20.0])
RTOL = 1e-6


def standing(*value: float) -> JointReference:
    return JointReference.at_rest(np.array(value))


def governor(
    axes: int = 1, dt_s: float = DT_S, own: FloatArray = OWN
) -> ReferenceGovernor[JointReference]:
    velocity, acceleration, jerk = (np.full(axes, BRAKE_MARGIN * limit) for limit in own)
    limits = GovernorLimits(velocity, acceleration, jerk, np.ones(axes), np.ones(axes))
    return ReferenceGovernor(JointSpace(), standing(*[0.0] * axes), dt_s, limits)


def led(side: ReferenceGovernor[JointReference], told: JointReference, ticks: int) -> FloatArray:
    """(ticks, n) where it is while the same is told."""
    path: list[FloatArray] = []
    for _ in range(ticks):
        side.follow(told, steady=False)
        path.append(side.motion.position_rad)
    return np.array(path)


@given(step=st.floats(-0.05, 0.05), small=st.floats(-1e-4, 1e-4))
@settings(max_examples=15)
def test_steps_of_any_size_are_joined_within_the_limits_and_made_up_for_wholly(
    step: float, small: float
) -> None:
    side = governor(2)
    path = led(side, standing(step, small), 1000)
    np.testing.assert_array_equal(path[-1], [step, small])
    assert not side.moving
    still = np.zeros((3, 2))
    for order, limit in enumerate(OWN, start=1):
        differences = np.diff(np.vstack([still, path]), order, axis=0) / DT_S**order
        assert np.abs(differences).max() <= BRAKE_MARGIN * limit * (1 + RTOL)


def test_fifty_millimetres_are_gone_soon_and_a_tenth_of_one_sooner() -> None:
    for step, after_s in ((0.05, 0.45), (0.02, SOON_S), (1e-4, SOON_S / 3)):
        path = led(governor(), standing(step), round(SOON_S / DT_S))
        np.testing.assert_array_equal(path[round(after_s / DT_S) :], step)


@pytest.mark.parametrize("seed", range(12))
def test_at_a_hundred_hertz_a_path_that_jumps_takes_no_more_than_acceleration_and_jerk(
    seed: int,
) -> None:
    rng, dt_s = np.random.default_rng(seed), 0.01
    side, (velocity, acceleration, jerk) = governor(dt_s=dt_s), OWN
    told, told_jerk, left = np.zeros(3), 0.0, 0
    path = np.zeros(403)
    for tick in range(400):
        jumps = left <= 0
        if jumps:
            left, told_jerk = int(rng.integers(3, 60)), rng.choice([-1, 0, 1]) * jerk
            told = rng.uniform(-1, 1, 3) * [0.02, 0.5 * velocity, acceleration] + [told[0], 0, 0]
        grows = abs(told[2] + told_jerk * dt_s) <= acceleration
        powers = dt_s ** np.array([3, 2, 1]) / [6, 2, 1]
        told = told + [told[1] * dt_s + told[2] * dt_s**2 / 2, told[2] * dt_s, 0]
        told = told + told_jerk * grows * powers
        left = 0 if abs(told[1]) > 0.8 * velocity else left - 1
        side.follow(JointReference(*told[:, None]), steady=not jumps)
        path[tick + 3] = side.motion.position_rad[0]
    for order, limit in ((2, acceleration), (3, jerk)):
        differences = np.diff(path, order) / dt_s**order
        assert np.abs(differences).max() <= BRAKE_MARGIN * limit * (1 + 1e-3)


@given(at=st.floats(0.2, 0.8), step=st.sampled_from([-0.1, 0.1]), ticks=st.integers(40, 90))
@settings(max_examples=40, deadline=None)
def test_beside_a_path_whose_jerk_reverses_within_a_tick_no_difference_exceeds_the_jerk(
    at: float, step: float, ticks: int
) -> None:
    side, jerk = governor(2), OWN[2]
    path = np.zeros((2 * ticks + 3, 2))
    for tick in range(2 * ticks):
        # One axis reverses its jerk `ticks + at` ticks after it began; the other begins then.
        time_s, after_s = (max(tick + 1 - begin, 0.0) * DT_S for begin in (0.0, ticks + at))
        told = [
            jerk / math.factorial(n) * np.array([time_s**n - 2 * after_s**n, after_s**n])
            for n in (3, 2, 1)
        ]
        told[0] = told[0] + (step if tick >= ticks - 10 else 0.0)
        side.follow(JointReference(*told), steady=tick not in (0, ticks - 10))
        path[tick + 3] = side.motion.position_rad
    third = np.diff(path, 3, axis=0) / DT_S**3
    assert np.abs(third).max() <= BRAKE_MARGIN * jerk * (1 + RTOL)


@given(step=st.floats(0.005, 0.05), begin=st.integers(5, 400), way=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=20)
def test_beside_a_path_that_begins_to_accelerate_no_difference_exceeds_the_acceleration(
    step: float, begin: int, way: float
) -> None:
    velocity, acceleration, jerk = own = np.array([0.5, 2.0, 200.0])
    side = governor(own=own)
    path = np.zeros(603)
    for tick in range(600):
        # As fast as may be from rest to the path's velocity limit.
        after_s = max(tick + 1 - begin, 0.0) * DT_S
        ramp_s, lasts_s = acceleration / jerk, velocity / acceleration
        told = np.zeros(3)
        for sign, at_s in ((1, 0.0), (-1, ramp_s), (-1, lasts_s), (1, lasts_s + ramp_s)):
            since_s = max(after_s - at_s, 0.0)
            told += [sign * way * jerk / math.factorial(n) * since_s**n for n in (3, 2, 1)]
        told[0] += step
        side.follow(JointReference(*told[:, None]), steady=tick > 0)
        path[tick + 3] = side.motion.position_rad[0]
    second = np.diff(path, 2) / DT_S**2
    assert np.abs(second).max() <= BRAKE_MARGIN * acceleration * (1 + RTOL)


@given(st.floats(-1e-15, 1e-15))
@settings(max_examples=25)
def test_noise_of_rounding_is_answered_by_noise(noise: float) -> None:
    side = governor(2)
    for told in (standing(noise, 0.01), standing(0.0, 0.01)):
        assert np.abs(led(side, told, 200)[:, 0]).max() <= 2e-15


def test_what_goes_on_as_promised_passes_unchanged() -> None:
    side = governor()
    for tick in range(1, 400):
        t = tick * DT_S
        told = JointReference(
            *(np.array([x]) for x in (OWN[2] * t**3 / 6, OWN[2] * t**2 / 2, OWN[2] * t))
        )
        side.follow(told, steady=False)
        assert side.motion is told


@pytest.mark.parametrize("at", [1, 20, 40, 60, 150])
def test_a_stop_may_begin_at_any_time_of_a_step(at: int) -> None:
    side, path = governor(), [0.0, 0.0, 0.0]
    path += led(side, standing(0.03), at)[:, 0].tolist()
    side.stop()
    while side.moving:
        side.rest()
        path.append(float(side.motion.position_rad[0]))
    for order, limit in enumerate(OWN, start=1):
        differences = np.diff(path, order) / DT_S**order
        assert np.abs(differences).max() <= BRAKE_MARGIN * limit * (1 + RTOL)
    assert not side.motion.velocity_rad_s.any()


numbers = st.lists(st.floats(-1, 1), min_size=18, max_size=18).map(np.array)


@given(numbers, numbers)
def test_a_pose_is_beside_another_where_it_was_found_to_be(a: FloatArray, b: FloatArray) -> None:
    space = PoseSpace()
    motion, base = (
        Motion(Pose(x[:3], exp3(x[3:6])), 2 * x[6:12], 5 * x[12:]) for x in (a, 0.5 * b)
    )
    found = space.beside(base, space.apart(motion, base))
    np.testing.assert_allclose(found.pose.position_m, motion.pose.position_m, atol=1e-9)
    assert angle_between(found.pose.rotation, motion.pose.rotation) < 1e-7
    np.testing.assert_allclose(found.twist, motion.twist, atol=1e-7)
    np.testing.assert_allclose(found.acceleration, motion.acceleration, atol=1e-6)


def test_a_stream_that_stood_still_for_a_moment_does_not_pull_the_reference_back() -> None:
    start = Pose(np.array([0.4, 0.0, 0.3]), np.eye(3))
    brake = MotionLimits((1.0, 4.0, 40.0), (3.0, 12.0, 120.0))
    guard = PoseGuard(start, DT_S, 0.1, brake)
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


def test_it_moves_as_long_as_one_axis_of_its_path_does() -> None:
    side, still = governor(2), np.zeros(2)
    change, rate = OWN[2] * DT_S, OWN[2] * DT_S**2 / 2
    told = JointReference(*np.outer([rate * DT_S / 3, rate, change], [1.0, 0.0]))
    side.follow(told, steady=False)
    assert side.motion is told
    assert side.moving
    side.put(JointReference(told.position_rad, still, still))
    assert not side.moving


def test_the_acceleration_of_a_command_goes_on_for_a_while_if_the_next_is_lost() -> None:
    axis = np.ones(1)
    brake = GovernorLimits(*(np.array([limit]) for limit in BRAKE_MARGIN * OWN), axis, axis)
    told = JointReference(np.zeros(1), 0.1 * axis, axis)
    later = Extrapolation(JointSpace(), told, None, 0.0, brake).at(ACCELERATE_S)
    assert later.velocity_rad_s[0] == pytest.approx(0.1 + ACCELERATE_S)
    assert later.position_rad[0] == pytest.approx(0.1 * ACCELERATE_S + ACCELERATE_S**2 / 2)


def test_a_turn_about_three_axes_ends_within_the_jerk_of_one_if_the_next_command_is_lost() -> None:
    axes, turn = np.ones(6), np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) / math.sqrt(3)
    brake = GovernorLimits(*(BRAKE_MARGIN * limit * axes for limit in OWN), axes, axes)
    here = Pose(np.zeros(3), np.eye(3))
    told = Motion(here, 0.01 * turn, OWN[1] * turn)
    path = Extrapolation(PoseSpace(), told, None, 0.0, brake)
    changes = [path.at(DT_S * tick).acceleration for tick in range(300)]
    jerk = np.linalg.norm(np.diff(changes, axis=0), axis=1) / DT_S
    assert 0.9 * OWN[2] < jerk.max() < 1.02 * OWN[2]
    assert np.linalg.norm(changes[-1]) < 0.05 * OWN[1]
