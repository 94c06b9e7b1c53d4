"""The robot's side of the joint stream, where it differs from poses (test_pose_guard.py)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from guard_rig import stop_from

from vla_zenoh.control.limits import BEGIN_JOINT, JointMotionLimits, joint_motion_limits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.guard.stream_guard import (
    BEGIN_RAD_S,
    JUMP_JOINT,
    JointGuard,
)
from vla_zenoh.profile import load_profile
from vla_zenoh.types import FloatArray, Header, JointCommand, JointReference, Stamped

PROFILE = load_profile("panda_sim")
NAMES = PROFILE.robot.arm_joints
HOME_RAD = np.array(PROFILE.robot.home_rad)
TURNS = np.zeros(len(NAMES), bool)
LOWER_RAD, UPPER_RAD = RANGE_RAD = HOME_RAD - 1.0, HOME_RAD + 1.0
TIMEOUT_S = PROFILE.timing.command_timeout_s
BRAKE = joint_motion_limits(PROFILE, BRAKE_MARGIN)
TICK_S = 1e-3
TICK_NS = 1_000_000
COMMAND_TICKS = 4
START_NS = 1_700_000_000_000_000_000
PATH_ATOL_RAD = 2e-5  # between two commands 4 ms apart the jerk is not known
STEP_RTOL = 1e-6
STEP_RAD = 1e-3
STREAM_S, RAMP_S = 0.004, 0.2
SWING_RAD = np.array([0.2, -0.1, 0.15, 0.1, -0.2, 0.3, -0.3])


def swing(time_s: float, period_s: float = 3.3) -> JointReference:
    """A smooth motion of every joint from rest at home, where it begins without acceleration."""
    w = 2 * np.pi / period_s
    once, twice = w * time_s, 2 * w * time_s
    return JointReference(
        HOME_RAD + SWING_RAD * (0.75 - np.cos(once) + 0.25 * np.cos(twice)),
        SWING_RAD * w * (np.sin(once) - 0.5 * np.sin(twice)),
        SWING_RAD * w * w * (np.cos(once) - np.cos(twice)),
    )


def stamped(
    motion: JointReference,
    seq: int,
    stamp_ns: int,
    *,
    source: str = "command#1",
    names: tuple[str, ...] = NAMES,
    late_ns: int = 0,
) -> Stamped[JointCommand]:
    return Stamped(
        Header(stamp_ns, seq, source), JointCommand(names, *motion, "active"), stamp_ns + late_ns
    )


def make_guard() -> JointGuard:
    return JointGuard(NAMES, HOME_RAD, TICK_S, TIMEOUT_S, BRAKE, RANGE_RAD, TURNS)


def begun() -> JointGuard:
    """A guard that follows a stream at home."""
    guard = make_guard()
    assert guard.offer(stamped(still(HOME_RAD), 0, START_NS), START_NS) is None
    return guard


def streamed(guard: JointGuard, duration_s: float) -> Iterator[tuple[int, JointReference]]:
    """Follow `swing`, a command every 4 ms, for so long: time and reference of every tick."""
    for tick in range(round(duration_s / TICK_S)):
        now_ns = START_NS + tick * TICK_NS
        if tick % COMMAND_TICKS == 0:
            refusal = guard.offer(stamped(swing(tick * TICK_S), tick, now_ns), now_ns)
            assert refusal is None
        yield now_ns, guard.tick(now_ns)


def in_motion(duration_s: float = 0.8) -> tuple[JointGuard, int]:
    """A guard that follows, and its time."""
    guard = make_guard()
    return guard, [now_ns for now_ns, _ in streamed(guard, duration_s)][-1]


def still(position_rad: FloatArray) -> JointReference:
    return JointReference.at_rest(position_rad)


# -- following --------------------------------------------------------------------------------
def test_between_two_commands_the_path_goes_on() -> None:
    guard = make_guard()
    for now_ns, motion in streamed(guard, 3.0):
        true = swing((now_ns - START_NS) / 1e9)
        np.testing.assert_allclose(motion.position_rad, true.position_rad, atol=PATH_ATOL_RAD)
    assert guard.following
    assert guard.silences == 0


def test_joints_in_another_order_are_put_in_the_arms() -> None:
    guard, turned = make_guard(), (*NAMES[2:], *NAMES[:2])
    for now_ns, expected in streamed(make_guard(), 0.5):
        tick = (now_ns - START_NS) // TICK_NS
        if tick % COMMAND_TICKS == 0:
            other = JointReference(*(np.roll(column, -2) for column in swing(tick * TICK_S)))
            assert guard.offer(stamped(other, tick, now_ns, names=turned), now_ns) is None
        for got, wanted in zip(guard.tick(now_ns), expected, strict=True):
            np.testing.assert_array_equal(got, wanted)


# -- refusing ---------------------------------------------------------------------------------
def refusal(guard: JointGuard, now_ns: int, motion: JointReference, **changes: object) -> str:
    command = stamped(motion, 10_000, now_ns, **changes)  # type: ignore[arg-type]
    reason = guard.offer(command, now_ns)
    assert reason is not None
    return reason


@pytest.mark.parametrize(
    "names",
    [
        NAMES[:-1] + ("panda_finger_joint1",),
        tuple(name.upper() for name in NAMES),
    ],
)
def test_other_joints_than_the_arms_are_refused(names: tuple[str, ...]) -> None:
    assert refusal(make_guard(), START_NS, still(HOME_RAD), names=names) == "names"


@pytest.mark.parametrize("count", [1, 6, 8])
def test_fewer_or_more_joints_than_the_arm_has_are_refused(count: int) -> None:
    names = (*NAMES, "extra")[:count]
    command = JointCommand(names, np.zeros(count), np.zeros(count), np.zeros(count), "active")
    header = Header(START_NS, 0, "command#1")
    assert make_guard().offer(Stamped(header, command, START_NS), START_NS) == "names"


@pytest.mark.parametrize("joint", range(7))
def test_a_jump_of_any_joint_is_refused_and_a_small_step_is_not(joint: int) -> None:
    for limit_rad, followed in ((BEGIN_JOINT.turns, False), (JUMP_JOINT.turns, True)):
        step = np.eye(7)[joint] * limit_rad * 1.01
        guard = begun() if followed else make_guard()
        assert refusal(guard, START_NS, still(HOME_RAD + step)) == "jump"
        assert guard.offer(stamped(still(HOME_RAD + 0.98 * step), 1, START_NS), START_NS) is None


@pytest.mark.parametrize("joint", range(7))
def test_a_stream_begins_at_rest(joint: int) -> None:
    for share, reason in ((0.99, None), (1.01, "too_fast")):
        velocity = np.eye(7)[joint] * -share * BEGIN_RAD_S
        given = JointReference(HOME_RAD, velocity, np.zeros(7))
        assert make_guard().offer(stamped(given, 0, START_NS), START_NS) == reason


@pytest.mark.parametrize("speed_rad_s", [0.1, 0.2, 0.3, 0.4, 0.5])
def test_a_stream_that_goes_on_after_the_robots_own_brake_makes_no_step(
    speed_rad_s: float,
) -> None:
    """Lost for a moment, and its writer brakes as well as soon as it hears of it."""
    dt_s = STREAM_S
    guard = JointGuard(NAMES, HOME_RAD, dt_s, TIMEOUT_S, BRAKE, RANGE_RAD, TURNS)
    velocity = np.eye(7)[0] * speed_rad_s
    slow = joint_motion_limits(PROFILE)
    stop, last, heard_s = None, guard.motion, np.inf
    for k in range(500):
        time_s, now_ns = k * dt_s, START_NS + round(k * dt_s * 1e9)
        if guard.braking and stop is None:
            heard_s = min(heard_s, time_s + 0.015)
        moved_s = max(time_s - RAMP_S / 2, 0.0)
        sent = JointReference(HOME_RAD + velocity * moved_s, velocity, np.zeros(7))
        if time_s < RAMP_S:
            share = time_s / RAMP_S
            way = velocity * (time_s * share / 2)
            sent = JointReference(HOME_RAD + way, velocity * share, velocity / RAMP_S)
        if stop is None and time_s >= heard_s:
            stop, heard_s = stop_from(sent, slow), time_s
        if stop is not None:
            sent = JointReference(*map(np.array, stop.at_time(time_s - heard_s)))
        if not 0.4 <= time_s < 0.53:
            guard.offer(stamped(sent, k, now_ns), now_ns)
        motion = guard.tick(now_ns)
        step = motion.position_rad - last.position_rad - last.velocity_rad_s * dt_s
        assert np.abs(step).max() < 0.5 * BRAKE.acceleration_rad_s2[0] * dt_s**2 * 1.1
        last = motion
    assert guard.silences == 1


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("order", [1, 2])
def test_a_joint_that_would_be_faster_than_its_own_limit_is_refused(joint: int, order: int) -> None:
    motion = list(still(HOME_RAD))
    limit = BRAKE[order - 1][joint]
    motion[order] = np.eye(7)[joint] * -1.01 * limit
    assert refusal(make_guard(), START_NS, JointReference(*motion)) == "too_fast"
    motion[order] = np.eye(7)[joint] * -0.99 * limit
    assert begun().offer(stamped(JointReference(*motion), 1, START_NS), START_NS) is None


def test_the_robot_allows_twice_what_the_profile_lets_the_stream_do() -> None:
    limits = PROFILE.limits.joint
    for name, allowed in zip(JointMotionLimits._fields, BRAKE, strict=True):
        np.testing.assert_allclose(allowed, 2.0 * np.array(limits.of(name, 7)))


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_a_joint_stays_within_its_range(end: float) -> None:
    outside = HOME_RAD.copy()
    outside[3] += end * 1.001
    near = HOME_RAD.copy()
    near[3] += end * 0.999
    guard = make_guard()
    guard.reset(near)
    assert refusal(guard, START_NS, still(outside)) == "out_of_range"
    guard.reset(outside)  # pushed out by hand: it may come back
    assert guard.offer(stamped(still(outside), 0, START_NS), START_NS) is None
    further = outside.copy()
    further[3] += end * 0.01
    assert refusal(guard, START_NS, still(further)) == "out_of_range"


def test_a_refused_command_changes_nothing() -> None:
    (guard, now_ns), (other, _) = in_motion(), in_motion()
    here = guard.motion.position_rad
    refusal(guard, now_ns, still(HOME_RAD - 0.5))
    refusal(guard, now_ns, JointReference(here, np.full(7, 9.0), np.zeros(7)))
    for tick in range(1, 20):
        after = now_ns + tick * TICK_NS
        for got, expected in zip(guard.tick(after), other.tick(after), strict=True):
            np.testing.assert_array_equal(got, expected)


# -- silence ----------------------------------------------------------------------------------
def silence(guard: JointGuard, now_ns: int, duration_s: float) -> list[JointReference]:
    return [guard.tick(now_ns + n * TICK_NS) for n in range(1, round(duration_s / TICK_S) + 1)]


def test_silence_in_motion_ends_in_a_jerk_limited_stop_of_every_joint() -> None:
    guard, now_ns = in_motion()
    before = guard.motion
    assert np.abs(before.velocity_rad_s).max() > 0.5
    path = [before, *silence(guard, now_ns, 2.0)]
    assert guard.silences == 1
    assert not guard.following
    assert not guard.braking
    position, velocity, acceleration = (np.array(column) for column in zip(*path, strict=True))
    assert not velocity[-1].any()
    assert not acceleration[-1].any()
    brake = BRAKE
    first = round(TIMEOUT_S / TICK_S) - COMMAND_TICKS - 1  # before the brake begins
    assert not acceleration[first].any()
    assert acceleration[first + COMMAND_TICKS + 2].any()
    assert (np.abs(acceleration[first:]) <= brake.acceleration_rad_s2 * (1 + STEP_RTOL)).all()
    steps = np.abs(np.diff(acceleration[first:], axis=0))
    assert (steps <= brake.jerk_rad_s3 * TICK_S * (1 + STEP_RTOL)).all()
    moved = np.abs(np.diff(position, axis=0))
    fastest = np.abs(velocity).max(axis=0)
    assert (moved <= fastest * TICK_S * (1 + STEP_RTOL)).all()


def test_a_stop_is_as_short_as_the_jerk_allows() -> None:
    limits = JointMotionLimits(np.full(1, 2.0), np.full(1, 4.0), np.full(1, 40.0))
    moving = JointReference(np.zeros(1), np.full(1, 1.0), np.zeros(1))
    path = stop_from(moving, limits)
    assert path is not None
    # v/a + a/j where the acceleration limit is reached.
    assert path.duration == pytest.approx(1.0 / 4.0 + 4.0 / 40.0)


def test_each_joint_stops_by_itself() -> None:
    guard, now_ns = in_motion(0.4)
    path = silence(guard, now_ns, 2.0)
    ends = [
        max(n for n, motion in enumerate(path) if abs(motion.velocity_rad_s[joint]) > 1e-9)
        for joint in range(7)
    ]
    assert len(set(ends)) > 1


def test_a_stop_that_cannot_be_planned_is_none() -> None:
    broken = JointReference(HOME_RAD, np.full(7, np.nan), np.zeros(7))
    assert stop_from(broken, BRAKE) is None


def test_a_clock_that_jumps_during_the_brake_moves_nothing() -> None:
    guard, now_ns = in_motion()
    silence(guard, now_ns, TIMEOUT_S + 0.02)
    path = [guard.motion]
    for step, jump_s in zip(range(200), itertools.cycle([2.0, -2.0])):
        path.append(guard.tick(now_ns + int((0.12 + step * TICK_S + jump_s) * 1e9)))
    moved = np.abs(np.diff([motion.position_rad for motion in path], axis=0))
    assert moved.max() <= np.abs(path[0].velocity_rad_s).max() * TICK_S * (1 + STEP_RTOL)


# -- being put elsewhere ----------------------------------------------------------------------
def test_a_restart_forgets_the_writer_and_an_anchor_does_not() -> None:
    guard, now_ns = in_motion()
    elsewhere = HOME_RAD + 0.3
    guard.anchor(elsewhere)
    assert not guard.following
    assert np.array_equal(guard.tick(now_ns).position_rad, elsewhere)
    assert guard.offer(stamped(still(elsewhere), 3, now_ns), now_ns) == "replayed"
    guard.reset(elsewhere)
    assert guard.offer(stamped(still(elsewhere), 3, now_ns), now_ns) is None


def test_a_restart_in_a_brake_ends_it() -> None:
    guard, now_ns = in_motion()
    silence(guard, now_ns, TIMEOUT_S + 0.02)
    assert guard.braking
    guard.reset(HOME_RAD)
    assert not guard.braking
    assert not np.any(guard.tick(now_ns).velocity_rad_s)


def test_limits_may_be_given_for_any_arm() -> None:
    brake = JointMotionLimits(np.ones(2), np.ones(2), np.full(2, 10.0))
    ends = np.full(2, -1.0), np.full(2, 1.0)
    guard = JointGuard(("a", "b"), np.zeros(2), TICK_S, 0.1, brake, ends, TURNS[:2])
    command = JointCommand(("b", "a"), [0.001, 0.002], [0, 0], [0, 0], "active")
    for tick in range(500):
        now_ns = START_NS + tick * TICK_NS
        given = Stamped(Header(now_ns, tick, "x"), command, now_ns)
        assert guard.offer(given, now_ns) is None
        motion = guard.tick(now_ns)
    np.testing.assert_array_equal(motion.position_rad, [0.002, 0.001])
