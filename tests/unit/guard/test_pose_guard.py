"""The robot's side of the pose stream: what it follows, refuses, and does in silence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.limits import MotionLimits, motion_limits
from vla_zenoh.control.smoothing import Smoother
from vla_zenoh.guard.stream_guard import PoseGuard, pose_brake_limits
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3, norm3, quat_from_rotation
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Header, PoseCommand, Stamped

MS = 1_000_000
TICK_S, STREAM_S = 0.001, 0.004
BRAKE = MotionLimits((1.0, 4.0, 40.0), (3.0, 12.0, 120.0))
TIMEOUT_S = 0.1
START = Pose(np.array([0.43, 0.0, 0.3]), exp3(np.array([3.0, 0.1, 0.0])))
SOURCE = "command-1"
RAMP_S = 0.4
SETTLED_MS = 550
RAMP_ATOL_M = 5e-6  # while its jerk changes: that is known only where the next command comes
LATE_ATOL_MS = 20.0
PATH_ATOL_M = 5e-5  # what clocks may drift apart while a command is held up
FOLLOWED_M, FOLLOWED_RAD = 1e-4, 1e-3
STEP_M, STEP_M_S = 4e-5, 0.017  # beside its own motion, in a tick of 4 ms: at 4 m/s^2
SHORT_STEP_M, CAUGHT_UP_M = 1e-4, 1e-5
RTOL = 1e-6


class Line:
    """Commands along x, stamped on the clock of their writer: from rest to a constant speed.

    The speed grows as a cosine does, within the half of `BRAKE` that a stream has.
    """

    def __init__(self, speed: float, ahead_ns: int = 0) -> None:
        self.speed, self.ahead_ns, self.seq = speed, ahead_ns, 0

    def x(self, t_ns: int) -> float:
        t_s = t_ns / 1e9
        ramp_s, w = min(t_s, RAMP_S), np.pi / RAMP_S
        way_m = self.speed * ((ramp_s - np.sin(w * ramp_s) / w) / 2 + t_s - ramp_s)
        return float(START.position_m[0]) + way_m

    def v(self, t_ns: int) -> float:
        return self.speed * (1 - np.cos(np.pi * min(t_ns / 1e9 / RAMP_S, 1.0))) / 2

    def a(self, t_ns: int) -> float:
        share = min(t_ns / 1e9 / RAMP_S, 1.0)
        return self.speed * np.pi / RAMP_S * float(np.sin(np.pi * share)) / 2

    def at(self, t_ns: int, arrives_ns: int | None = None, **how: Any) -> Stamped[PoseCommand]:
        self.seq += 1
        header = Header(10**15 + t_ns + self.ahead_ns, self.seq, SOURCE)
        arrives_ns = t_ns if arrives_ns is None else arrives_ns
        how = {"acceleration": self.a(t_ns), **how}
        return command(self.x(t_ns), self.v(t_ns), header, arrives_ns, **how)


def command(
    x: float,
    speed: float,
    header: Header,
    arrives_ns: int,
    *,
    spin: float = 0.0,
    acceleration: float = 0.0,
) -> Stamped[PoseCommand]:
    quat = quat_from_rotation(START.rotation)
    position_m = np.array([x, 0.0, 0.3])
    twist = np.array([speed, 0, 0, spin, 0, 0])
    change = np.array([acceleration, 0, 0, 0, 0, 0])
    record = PoseCommand(position_m, quat, twist, change, position_m, quat, "active")
    return Stamped(header, record, 10**15 + arrives_ns)


def guard() -> PoseGuard:
    return PoseGuard(START, TICK_S, TIMEOUT_S, BRAKE)


def now(t_ns: int) -> int:
    return 10**15 + t_ns


def test_it_stands_until_somebody_commands() -> None:
    side = guard()
    for t in range(100):
        motion = side.tick(now(t * MS))
    np.testing.assert_array_equal(motion.pose.position_m, START.position_m)
    assert not side.following


@pytest.mark.parametrize("ahead_ns", [0, 10**12, -5 * 10**11])
def test_between_two_commands_it_goes_on_along_the_path_whatever_clock_they_are_stamped_by(
    ahead_ns: int,
) -> None:
    side, line = guard(), Line(0.3, ahead_ns)
    for t in range(800):
        if t % 4 == 0:
            assert side.offer(line.at(t * MS), now(t * MS)) is None
        x = float(side.tick(now(t * MS)).pose.position_m[0])
        assert x == pytest.approx(line.x(t * MS), abs=RAMP_ATOL_M if t < SETTLED_MS else 1e-9)


@pytest.mark.parametrize("held_up_ms", [5, 30, 80])
def test_a_command_that_was_held_up_on_its_way_does_not_pull_it_back(held_up_ms: int) -> None:
    side, line, before = guard(), Line(0.4), 0.0
    for t in range(900):
        if t == 500 + held_up_ms:  # all that were held up arrive at once
            for late in range(500, t, 4):
                side.offer(line.at(late * MS, arrives_ns=t * MS), now(t * MS))
        if t % 4 == 0 and not 500 <= t < 500 + held_up_ms:
            side.offer(line.at(t * MS), now(t * MS))
        x = float(side.tick(now(t * MS)).pose.position_m[0])
        assert x == pytest.approx(line.x(t * MS), abs=PATH_ATOL_M)
        assert x > before or t < 4
        before = x


def test_a_stream_that_comes_later_and_later_ends_as_one_that_fell_silent() -> None:
    """Half of what is written gets through a link in time, all of it in order, with no pause."""
    side, line, slow_ms = guard(), Line(0.1), 300
    said: dict[str | None, int] = {}
    for t in range(1500):
        late_ms = max(t - slow_ms, 0) // 2
        if t % (8 if late_ms else 4) == 0:
            written_ns = (t - late_ms) * MS
            said.setdefault(side.offer(line.at(written_ns, arrives_ns=t * MS), now(t * MS)), t)
        side.tick(now(t * MS))
    assert said["late"] == pytest.approx(slow_ms + 2 * TIMEOUT_S * 1e3, abs=LATE_ATOL_MS)
    # What is taken then has been refused for as long as a stream may be silent.
    assert said["braking"] - said["late"] == pytest.approx(TIMEOUT_S * 1e3, abs=LATE_ATOL_MS)
    assert side.silences == 1
    assert not side.braking
    assert norm3(side.motion.twist[:3]) == 0.0


@pytest.mark.parametrize("step_ns", [-2 * 10**9, 2 * 10**9])
def test_a_writer_whose_clock_is_set_is_followed_on(step_ns: int) -> None:
    side, line = guard(), Line(0.3)
    for t in range(900):
        if t % 4 == 0:
            line.ahead_ns = step_ns if t >= 600 else 0
            assert side.offer(line.at(t * MS), now(t * MS)) is None
        x = float(side.tick(now(t * MS)).pose.position_m[0])
        assert x == pytest.approx(line.x(t * MS), abs=RAMP_ATOL_M if t < SETTLED_MS else 1e-6)


def test_one_stamp_from_the_future_does_not_spoil_the_clock() -> None:
    side, line = guard(), Line(0.3)
    for t in range(0, 900, 4):
        given = line.at(t * MS)
        if t == 600:
            header = Header(given.header.stamp_wall_ns + 5 * 10**9, given.header.seq, SOURCE)
            given = Stamped(header, given.record, given.received_ns)
        side.offer(given, now(t * MS))
        for ms in range(t, t + 4):
            x = float(side.tick(now(ms * MS)).pose.position_m[0])
            assert x == pytest.approx(line.x(ms * MS), abs=RAMP_ATOL_M if t < SETTLED_MS else 1e-6)


def test_a_real_stream_is_followed_closely() -> None:
    side, leader = (
        guard(),
        Smoother(START, STREAM_S, motion_limits(load_profile("panda_sim").limits)),
    )
    turned = exp3(np.array([0.0, 0.3, 0.2])) @ START.rotation
    leader.target(Pose(START.position_m + [0.1, 0.05, -0.1], turned))
    for k in range(400):
        sent = leader.tick()
        quat = quat_from_rotation(sent.pose.rotation)
        record = PoseCommand(
            sent.pose.position_m, quat, sent.twist, sent.acceleration, START.position_m, quat, ""
        )
        at_ns = now(k * 4 * MS)
        assert side.offer(Stamped(Header(at_ns, k, SOURCE), record, at_ns), at_ns) is None
        for ms in range(4):
            motion = side.tick(at_ns + ms * MS)
            assert norm3(motion.pose.position_m - sent.pose.position_m) < ms * 6e-4 + FOLLOWED_M
        assert angle_between(motion.pose.rotation, sent.pose.rotation) < 3 * 1.6e-3 + FOLLOWED_RAD


def test_a_second_writer_is_foreign_while_the_first_one_speaks() -> None:
    side, line = guard(), Line(0.0)
    side.offer(line.at(0), now(0))
    other = command(0.43, 0.0, Header(now(4 * MS), 1, "command-2"), 4 * MS)
    assert side.offer(other, now(4 * MS)) == "foreign"
    for t in range(120):
        side.tick(now(t * MS))
    assert not side.following
    assert side.offer(other, now(120 * MS)) is None


def test_a_command_that_comes_again_or_late_is_replayed() -> None:
    side, line = guard(), Line(0.0)
    first, second = line.at(0), line.at(4 * MS)
    assert side.offer(second, now(4 * MS)) is None
    assert side.offer(first, now(4 * MS)) == "replayed"
    assert side.offer(second, now(8 * MS)) == "replayed"


@pytest.mark.parametrize(("x", "reason"), [(0.449, None), (0.451, "jump"), (0.4, "jump")])
def test_a_jump_is_refused(x: float, reason: str | None) -> None:
    side = guard()
    assert side.offer(command(0.43, 0.0, Header(now(0), 1, SOURCE), 0), now(0)) is None
    assert side.offer(command(x, 0.0, Header(now(0), 2, SOURCE), 0), now(0)) == reason


@pytest.mark.parametrize(("x", "reason"), [(0.4315, None), (0.4325, "jump")])
def test_a_stream_begins_where_the_reference_is(x: float, reason: str | None) -> None:
    assert guard().offer(command(x, 0.0, Header(now(0), 1, SOURCE), 0), now(0)) == reason


@pytest.mark.parametrize(
    ("speed", "spin", "reason"),
    [(0.029, 0.09, None), (0.031, 0.0, "too_fast"), (0.0, 0.11, "too_fast")],
)
def test_a_stream_begins_at_rest(speed: float, spin: float, reason: str | None) -> None:
    given = command(0.43, speed, Header(now(0), 1, SOURCE), 0, spin=spin)
    assert guard().offer(given, now(0)) == reason


def test_one_command_of_a_stranger_at_the_right_place_moves_nothing() -> None:
    side = guard()
    side.offer(command(0.43, 1.0, Header(now(0), 7, "anybody#1"), 0), now(0))
    for t in range(300):
        motion = side.tick(now(t * MS))
    np.testing.assert_array_equal(motion.pose.position_m, START.position_m)


@pytest.mark.parametrize(("turn_rad", "followed"), [(0.009, False), (0.09, True)])
def test_a_turn_that_jumps_is_refused(turn_rad: float, followed: bool) -> None:
    for by_rad, reason in ((turn_rad, None), (turn_rad * 1.2, "jump")):
        side = guard()
        if followed:
            assert side.offer(command(0.43, 0.0, Header(now(0), 1, SOURCE), 0), now(0)) is None
        quat = quat_from_rotation(exp3(np.array([0.0, 0.0, by_rad])) @ START.rotation)
        at_m = START.position_m
        record = PoseCommand(at_m, quat, np.zeros(6), np.zeros(6), at_m, quat, "active")
        assert side.offer(Stamped(Header(now(0), 2, SOURCE), record, now(0)), now(0)) == reason


@pytest.mark.parametrize(
    "how",
    [{"speed": 1.05}, {"spin": 3.05}, {"acceleration": 4.05}],
    ids=lambda how: next(iter(how)),
)
def test_a_command_faster_than_any_stream_of_ours_is_refused(how: dict[str, float]) -> None:
    speed = how.pop("speed", 0.0)
    given = command(0.43, speed, Header(now(0), 1, SOURCE), 0, **how)
    assert guard().offer(given, now(0)) == "too_fast"


def test_silence_in_motion_is_a_brake_within_the_limits() -> None:
    side, line = guard(), Line(0.5)
    for t in range(200):
        if t % 4 == 0:
            side.offer(line.at(t * MS), now(t * MS))
        before = side.tick(now(t * MS))
    end_ns = 196 * MS
    braking = []
    for t in range(200, 1500):
        motion = side.tick(now(t * MS))
        jerk = (motion.acceleration - before.acceleration) / TICK_S
        assert np.abs(jerk[:3]).max() <= BRAKE.translation[2] * (1 + RTOL)
        assert np.abs(motion.acceleration[:3]).max() <= BRAKE.translation[1] * (1 + RTOL)
        step_m = motion.pose.position_m[0] - before.pose.position_m[0]
        assert -1e-12 <= step_m <= 0.5 * TICK_S * (1 + RTOL)
        if side.braking:
            braking.append(t * MS - end_ns)
        before = motion
    assert braking[0] == pytest.approx(TIMEOUT_S * 1e9, abs=2 * MS)
    assert side.silences == 1
    assert not side.braking
    np.testing.assert_array_equal(before.twist, np.zeros(6))


@pytest.mark.parametrize("held_up_ms", [1, 5, 29, 60])
def test_silence_after_a_command_that_was_held_up_does_not_stop_it_within_a_tick(
    held_up_ms: int,
) -> None:
    side, line = guard(), Line(0.2)
    x_m = []
    for t in range(1500):
        if t % 4 == 0 and t < 396:
            side.offer(line.at(t * MS), now(t * MS))
        if t == 396 + held_up_ms:
            assert side.offer(line.at(396 * MS, t * MS), now(t * MS)) is None
        x_m.append(side.tick(now(t * MS)).pose.position_m[0])
    hardest_m_s2 = np.abs(np.diff(x_m, 2)).max() / TICK_S**2
    assert hardest_m_s2 <= BRAKE.translation[1] * (1 + RTOL)
    assert side.silences == 1


def test_while_it_brakes_by_itself_it_takes_no_commands_and_afterwards_it_does() -> None:
    side, line = guard(), Line(0.5)
    for t in range(100):
        if t % 4 == 0:
            side.offer(line.at(t * MS), now(t * MS))
        side.tick(now(t * MS))
    t = 100
    while not side.braking:
        side.tick(now(t * MS))
        t += 1
    assert side.offer(line.at(t * MS), now(t * MS)) == "braking"
    while side.braking:
        side.tick(now(t * MS))
        t += 1
    x = float(side.motion.pose.position_m[0])
    assert (
        side.offer(command(x, 0.0, Header(now(t * MS), 1000, SOURCE), t * MS), now(t * MS)) is None
    )


def test_a_stream_that_ends_at_rest_has_ended_on_purpose() -> None:
    side, line = guard(), Line(0.0)
    for t in range(300):
        if t == 0:
            side.offer(line.at(0), now(0))
        motion = side.tick(now(t * MS))
    assert side.silences == 0
    assert not side.following
    np.testing.assert_array_equal(motion.pose.position_m, START.position_m)


def test_restart_follows_nobody_from_another_place() -> None:
    side, line = guard(), Line(0.4)
    side.offer(line.at(0), now(0))
    there = Pose(np.array([0.5, 0.2, 0.2]), START.rotation)
    side.reset(there)
    motion = side.tick(now(MS))
    assert not side.following
    np.testing.assert_array_equal(motion.pose.position_m, there.position_m)
    np.testing.assert_array_equal(motion.twist, np.zeros(6))


@pytest.mark.parametrize("tick_ms", [1, 4])
@given(
    speed=st.floats(0.05, 0.5),
    gaps_ms=st.lists(st.integers(1, 60), min_size=1, max_size=4),
    begins_m=st.floats(-0.0019, 0.0019),
    heard=st.booleans(),
)
@settings(max_examples=8, deadline=None)
def test_the_reference_never_steps_whoever_was_late(
    tick_ms: int, speed: float, gaps_ms: list[int], begins_m: float, heard: bool
) -> None:
    side = PoseGuard(START, tick_ms * 1e-3, TIMEOUT_S, BRAKE)
    line, t, last = Line(speed), 0, side.motion
    for gap_ms in [0, *gaps_ms]:
        # This side slept: what came meanwhile lies in a heap, or was lost as well.
        for late in range(t // 4 * 4 + 4, t + gap_ms, 4) if heard else ():
            side.offer(line.at(late * MS, arrives_ns=(t + gap_ms) * MS), now((t + gap_ms) * MS))
        t += gap_ms // 4 * 4
        for _ in range(0, 200, tick_ms):
            if t % 4 == 0:
                given = line.at(t * MS)
                record = replace(
                    given.record, position_m=given.record.position_m + [begins_m, 0, 0]
                )
                side.offer(replace(given, record=record), now(t * MS))
            motion = side.tick(now(t * MS))
            way_m = motion.pose.position_m[0] - last.pose.position_m[0]
            assert abs(way_m - last.twist[0] * tick_ms * 1e-3) < STEP_M
            assert abs(motion.twist[0] - last.twist[0]) < STEP_M_S
            last = motion
            t += tick_ms


@pytest.mark.parametrize("asleep_ms", [12, 60, 95])
def test_a_side_that_was_woken_late_goes_on_from_what_it_sent_last(asleep_ms: int) -> None:
    side, line = PoseGuard(START, STREAM_S, TIMEOUT_S, BRAKE), Line(0.2)
    for t in range(0, 400, 4):
        side.offer(line.at(t * MS), now(t * MS))
        sent = side.tick(now(t * MS))
    t += 4 + asleep_ms
    side.offer(line.at(t * MS), now(t * MS))
    step_m = side.tick(now(t * MS)).pose.position_m[0] - sent.pose.position_m[0]
    assert step_m == pytest.approx(0.2 * STREAM_S, abs=SHORT_STEP_M)
    for _ in range(200):
        t += 4
        side.offer(line.at(t * MS), now(t * MS))
        x = side.tick(now(t * MS)).pose.position_m[0]
    assert x == pytest.approx(line.x(t * MS), abs=CAUGHT_UP_M)


def test_a_side_that_slept_too_long_stands_where_it_sent_the_arm_last() -> None:
    side, line = guard(), Line(0.5)
    for t in range(200):
        if t % 4 == 0:
            side.offer(line.at(t * MS), now(t * MS))
        sent = side.tick(now(t * MS))
    side.hold()
    for t in range(10_200, 10_500):
        motion = side.tick(now(t * MS))
    np.testing.assert_array_equal(motion.pose.position_m, sent.pose.position_m)
    np.testing.assert_array_equal(motion.twist, np.zeros(6))
    assert side.offer(line.at(196 * MS), now(t * MS)) is not None, "it is on its way already"
    again = command(line.x(100 * MS), 0.0, Header(now(0), 1, SOURCE), t * MS)
    assert side.offer(again, now(t * MS)) == "replayed", "what was heard stays heard"


def test_the_robots_own_stop_may_be_twice_as_hard_as_the_stream() -> None:
    profile = load_profile("panda_sim")
    limits = pose_brake_limits(profile)
    assert limits.translation == (1.0, 4.0, 40.0)
    assert limits.rotation == (3.0, 12.0, 120.0)


@pytest.mark.parametrize("every_ms", [1, 2, 5])
def test_a_stop_takes_as_long_whatever_the_period_of_the_controller(every_ms: int) -> None:
    """From 0.5 m/s, with 4 m/s^2 and 40 m/s^3: 0.225 s."""
    side, line = guard(), Line(0.5)
    for t in range(0, 600, every_ms):
        if t % 10 == 0:
            assert side.offer(line.at(t * MS), now(t * MS)) is None
        side.tick(now(t * MS), every_ms * 1e-3)
    side.stop()
    while side.moving:
        t += every_ms
        side.tick(now(t * MS), every_ms * 1e-3)
    assert t - 600 == pytest.approx(225, abs=12)
