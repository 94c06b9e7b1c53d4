"""The robot's side of the ROS 2 node: states, frames, clock, goals, hold."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from vla_zenoh_ros2.gripper import ActionGoal, GoalSequencer

from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import ARM_SETTLES_NS, MOVED_M, MOVED_RAD, HeldReference, Measured
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.joint_reading import (
    BEYOND,
    JointReading,
    RobotClock,
    SimulatedClock,
    StampFilter,
)
from vla_zenoh.types import GripperCommand
from vla_zenoh.types.records import Joints

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
ALL = (*ARM_JOINTS, *FINGERS)
MS = 1_000_000
POSITION_TOLERANCE_M = 1e-12
PROFILE = load_profile("panda_ros2")
STROKE_M = 0.08


def joints(names: tuple[str, ...] = ALL, **changes: Any) -> Joints:
    position = np.array([*HOME_RAD, 0.01, 0.02])[: len(names)]
    given: dict[str, Any] = {
        "names": names,
        "position": position,
        "velocity": np.zeros(len(names)),
        "effort": np.zeros(len(names)),
    }
    return Joints(0, **(given | changes))


@pytest.fixture
def arm() -> JointReading:
    return JointReading(PROFILE, panda())


def reason(call: Any, *arguments: Any) -> str:
    with pytest.raises(CodecError) as caught:
        call(*arguments)
    return caught.value.reason


# -- joint states ---------------------------------------------------------------------------------
def test_joints_in_any_order_become_the_arms_own(arm: JointReading) -> None:
    backwards = joints()._replace(names=ALL[::-1], position=joints().position[::-1])
    state = arm.take(backwards, 1)
    assert state is not None
    assert state.names == ARM_JOINTS
    assert state.position_rad.tolist() == HOME_RAD.tolist()
    assert arm.width_m == pytest.approx(0.03)
    expected = panda().forward(HOME_RAD).position_m
    assert (
        np.abs(arm.measurement(None, None).tcp.position_m - expected).max() < POSITION_TOLERANCE_M
    )


def test_one_finger_stands_for_both(arm: JointReading) -> None:
    arm.take(joints(names=(*ARM_JOINTS, FINGERS[0])), 1)
    assert arm.width_m == pytest.approx(0.02)


def test_other_robots_joints_say_nothing(arm: JointReading) -> None:
    assert arm.take(joints(names=("left_wheel", "right_wheel")), 1) is None
    assert arm.joints is None


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (joints(names=ARM_JOINTS[:3]), "partial"),
        (joints(position=np.array([math.nan, *np.zeros(8)])), "invalid"),
        (joints(position=np.array([*np.zeros(8), math.inf])), "invalid"),
        (joints(velocity=np.array([math.inf, *np.zeros(8)])), "invalid"),
        (joints(velocity=np.array([1e308, *np.zeros(8)])), "invalid"),
        (joints(position=np.array([-1e306, *np.zeros(8)])), "invalid"),
        (joints(position=np.array([*np.zeros(7), 1e308, 1e308])), "invalid"),
        # Fingers that report a share of their opening, not metres.
        (joints(position=np.array([*np.zeros(7), 0.5, 0.5])), "invalid"),
    ],
)
def test_what_is_not_whole_is_refused(arm: JointReading, message: Joints, why: str) -> None:
    assert reason(arm.take, message, 1) == why
    assert arm.joints is None


def test_a_position_far_off_after_a_sane_one_is_refused_and_the_sane_one_stays(
    arm: JointReading,
) -> None:
    sane = joints(names=ARM_JOINTS, velocity=None)
    arm.take(sane, 10 * MS)
    assert reason(arm.take, sane._replace(position=np.full(7, 1e306)), 10 * MS + 1000) == "invalid"
    assert arm.joints is not None
    assert arm.joints.position_rad.tolist() == HOME_RAD.tolist()
    assert arm.take(sane, 10 * MS + 1000) is not None, "its stamp is not used up"


@given(
    st.lists(st.floats(), min_size=9, max_size=9),
    st.none() | st.lists(st.floats(), min_size=9, max_size=9),
    st.integers(1, 2**62),
)
def test_whatever_joints_are_told_a_pose_can_be_made_of_what_is_taken(
    position: list[float], velocity: list[float] | None, later_ns: int
) -> None:
    arm = JointReading(PROFILE, panda())
    arm.take(joints(), 1)
    told = joints(
        position=np.array(position), velocity=None if velocity is None else np.array(velocity)
    )
    with contextlib.suppress(CodecError):
        arm.take(told, 1 + later_ns)
    arm.measurement(None, None)
    arm.gripper(busy=False, wanted_m=None, held=False)


def test_an_arm_at_the_ends_of_its_range_at_full_speed_is_taken(arm: JointReading) -> None:
    kinematics = panda()
    for number, at in enumerate((kinematics.lower_rad, kinematics.upper_rad), 1):
        told = joints(
            position=np.array([*at, 0.04, 0.04]),
            velocity=np.array([*kinematics.velocity_rad_s, 0, 0]),
        )
        assert arm.take(told, number) is not None


def test_two_messages_stamped_at_nearly_one_time_do_not_make_an_arm_infinitely_fast(
    arm: JointReading,
) -> None:
    arm.take(joints(velocity=None), 10 * MS)
    state = arm.take(joints(velocity=None, position=joints().position + 0.01), 10 * MS + 1)
    assert state is not None
    assert (np.abs(state.velocity_rad_s) <= BEYOND * panda().velocity_rad_s).all()


def test_efforts_that_are_missing_are_unknown(arm: JointReading) -> None:
    for number, effort in enumerate((None, np.full(9, math.nan)), 1):
        state = arm.take(joints(effort=effort), number)
        assert state is not None
        assert state.effort_nm is None
        assert arm.efforts_missing == number


def test_velocities_that_are_missing_are_made_of_differences(arm: JointReading) -> None:
    arm.take(joints(velocity=None), 10 * MS)
    moved = joints().position + 0.01
    state = arm.take(joints(velocity=None, position=moved), 20 * MS)
    assert state is not None
    assert state.velocity_rad_s == pytest.approx(np.ones(7))


def test_the_twist_of_the_tcp_follows_the_joints(arm: JointReading) -> None:
    velocity = np.array([0.1, -0.2, 0.3, 0.1, 0.0, 0.2, 0.5, 0.0, 0.0])
    arm.take(joints(velocity=velocity), 1)
    step_s = 1e-6
    kinematics = panda()
    before = kinematics.forward(HOME_RAD)
    after = kinematics.forward(HOME_RAD + velocity[:7] * step_s)
    expected = (after.position_m - before.position_m) / step_s
    assert arm.measurement(None, None).pose.twist[:3] == pytest.approx(expected, abs=1e-6)


def test_a_stamp_that_stands_still_is_a_frozen_robot() -> None:
    newness = StampFilter()
    newness.check(1000 * MS)
    assert reason(newness.check, 1000 * MS) == "frozen"
    assert reason(newness.check, 999 * MS) == "out_of_order"
    newness.check(1001 * MS)
    newness.check(0)  # started anew


def test_fingers_that_move_are_seen(arm: JointReading) -> None:
    arm.take(joints(velocity=np.array([*np.zeros(7), 0.01, 0.01])), 1)
    state = arm.gripper(busy=False, wanted_m=None, held=True)
    assert state is not None
    assert state.moving
    assert not state.holding
    arm.take(joints(), 2)
    state = arm.gripper(busy=False, wanted_m=None, held=True)
    assert state is not None
    assert not state.moving
    assert state.holding


def test_a_gripper_of_which_nothing_was_heard_has_no_state(arm: JointReading) -> None:
    arm.take(joints(names=ARM_JOINTS), 1)
    assert arm.gripper(busy=False, wanted_m=0.01, held=False) is None


EPOCH_NS = 1_790_000_000 * 10**9


# -- the robot's clock ----------------------------------------------------------------------------
@pytest.mark.parametrize(("behind_s", "differs"), [(0.0, False), (2.5, True), (-0.3, True)])
def test_the_offset_of_the_robots_clock_is_the_least_delay(behind_s: float, differs: bool) -> None:
    clock = RobotClock()
    for number in range(100):
        now_ns = 10**15 + number * 10 * MS
        delay_ns = (3 + number % 7) * MS
        stamp_ns = now_ns - int(behind_s * 1e9)
        clock.take(stamp_ns, now_ns + delay_ns)
    assert clock.offset_s == pytest.approx(behind_s + 0.003)
    assert clock.differs is differs


def test_what_has_no_stamp_says_nothing_of_the_clock() -> None:
    clock = RobotClock()
    clock.take(0, 123)
    assert clock.unstamped == 1
    assert clock.offset_s is None
    assert not clock.differs


# -- simulated time -------------------------------------------------------------------------------
@pytest.mark.parametrize("rate", [0.3, 1.0, 3.0])
def test_simulated_time_of_any_rate_is_translated_by_the_arrivals_of_joint_states(
    rate: float,
) -> None:
    clock = SimulatedClock()
    for number in range(200):
        clock.take(7 * MS + round(number * 10 * MS * rate), EPOCH_NS + number * 10 * MS)
    assert clock.rate == pytest.approx(rate, rel=1e-3)
    now_ns = EPOCH_NS + 1990 * MS
    for age_ms in (0, 40, 333, 990):
        stamp_ns = clock.newest_ns - round(age_ms * MS * rate)
        assert clock.wall_ns(stamp_ns, now_ns) == pytest.approx(now_ns - age_ms * MS, abs=11 * MS)
    ahead_ns = clock.newest_ns + round(20 * MS * rate)
    assert clock.wall_ns(ahead_ns, now_ns + 50 * MS) == pytest.approx(now_ns + 20 * MS, abs=MS)
    assert clock.wall_ns(ahead_ns, now_ns) == now_ns, "nothing was made after it arrived"


def test_simulated_time_that_stands_still_or_is_set_back_begins_anew() -> None:
    clock = SimulatedClock()
    assert clock.wall_ns(5 * MS, EPOCH_NS) == EPOCH_NS
    for number in range(100):
        clock.take(90_000 * MS + number * MS, EPOCH_NS + number * MS)
    paused_ns = EPOCH_NS + 60_000 * MS
    for number in range(300):
        clock.take(90_100 * MS + number * MS, paused_ns + number * MS)
    assert clock.rate == pytest.approx(1.0, rel=1e-3)
    assert clock.wall_ns(90_390 * MS, paused_ns + 299 * MS) == paused_ns + 290 * MS
    assert clock.wall_ns(89_000 * MS, paused_ns + 299 * MS) == paused_ns - 1100 * MS
    clock.take(1 * MS, paused_ns + 400 * MS)
    assert (clock.newest_ns, clock.rate) == (1 * MS, 1.0)
    late_ns = paused_ns + 401 * MS
    assert clock.wall_ns(90_398 * MS, late_ns) == late_ns, "of before it was set back"
    assert clock.wall_ns(late_ns, late_ns) == late_ns, "of another clock"


# -- gripper goals --------------------------------------------------------------------------------
def wish(width_m: float) -> GripperCommand:
    return GripperCommand(width_m, 0.1, 10.0)


def test_a_newer_wish_cancels_and_is_sent_when_the_goal_has_ended() -> None:
    keeper = GoalSequencer(5.0, STROKE_M)
    keeper.wish = wish(0.0)
    assert keeper.step(0) == "send"
    keeper.wish = wish(0.02)
    keeper.wish = wish(0.08)
    assert keeper.step(1) is None, "nothing is cancelled that was not accepted"
    goal = keeper.goal
    assert goal is not None
    keeper.accepted(goal, 2)
    assert keeper.step(3) == "cancel"
    assert keeper.step(4) is None, "and that once"
    assert keeper.ended(goal)
    assert keeper.step(5) == "send"
    assert keeper.goal is not None
    assert keeper.goal.command.width_m == 0.08, "the newest wins"


def test_a_goal_of_which_nothing_is_heard_is_given_up() -> None:
    keeper = GoalSequencer(1.0, STROKE_M)
    keeper.wish = wish(0.0)
    keeper.step(0)
    goal = keeper.goal
    assert goal is not None
    keeper.wish = wish(0.05)
    assert keeper.step(900 * MS) is None
    assert keeper.step(1001 * MS) == "send"
    assert keeper.timeouts == 1
    assert not keeper.ended(goal), "what is heard of it later is not heard"


def test_slow_fingers_have_the_time_they_need_and_who_is_silent_has_not() -> None:
    keeper = GoalSequencer(1.0, STROKE_M)
    keeper.wish = GripperCommand(0.0, 0.01, 10.0)
    keeper.step(0)
    assert keeper.goal is not None
    keeper.accepted(keeper.goal, 500 * MS)
    keeper.step(9499 * MS)
    assert keeper.goal is not None, "8 s for the way, and one"
    keeper.step(9501 * MS)
    assert keeper.goal is None
    keeper.wish = GripperCommand(0.0, 0.01, 10.0)
    keeper.step(10_000 * MS)
    assert keeper.goal is not None
    keeper.accepted(keeper.goal, 10_000 * MS)
    keeper.wish = wish(0.08)
    assert keeper.step(10_000 * MS) == "cancel"
    assert keeper.step(11_001 * MS) == "send", "a cancelled one ends at once"


def test_a_wish_that_is_forgotten_is_not_sent_and_the_goal_in_flight_goes_on() -> None:
    keeper = GoalSequencer(1.0, STROKE_M)
    keeper.wish = wish(0.0)
    keeper.step(0)
    keeper.wish = wish(0.08)
    keeper.wish = None
    goal = keeper.goal
    assert goal is not None
    assert goal.command == wish(0.0)
    assert keeper.ended(goal)
    assert keeper.step(1) is None
    assert keeper.goal is None


@given(st.lists(st.sampled_from(["want", "accept", "end", "step", "late end"]), max_size=60))
def test_there_are_never_two_goals_and_the_last_wish_is_never_lost(steps: list[str]) -> None:
    keeper = GoalSequencer(1e6, STROKE_M)
    goals: list[ActionGoal] = []
    running = False
    sent: list[float] = []
    wishes: list[float] = []
    now_ns = 0

    def step() -> None:
        nonlocal running
        if keeper.step(now_ns) == "send":
            assert keeper.goal is not None
            assert not running
            running = True
            goals.append(keeper.goal)
            sent.append(keeper.goal.command.width_m)

    for what in steps:
        now_ns += 1
        if what == "want":
            wishes.append(len(wishes) / 1000)
            keeper.wish = wish(wishes[-1])
        elif what == "accept" and keeper.goal is not None:
            keeper.accepted(keeper.goal, now_ns)
        elif what == "end" and running:
            assert keeper.ended(goals[-1])
            running = False
        elif what == "late end" and len(goals) > 1:
            assert not keeper.ended(goals[-2])
        else:
            step()
    for _ in range(2):
        if keeper.goal is not None:
            keeper.ended(keeper.goal)
        running = False
        step()
    assert sent[-1:] == wishes[-1:]
    assert sent == sorted(sent)


# -- where the controller holds the arm -----------------------------------------------------------
def at(x_m: float, elbow_rad: float = 0.0) -> Measured:
    pose = Pose(np.array([x_m, 0.0, 0.0]), np.eye(3))
    return Measured(pose, np.array([elbow_rad, 0.0]), np.zeros(2))


def test_what_was_sent_last_counts_until_somebody_moves_the_arm() -> None:
    hold = HeldReference(np.zeros(2, bool))
    assert not hold.update(at(0), 0)
    hold.on_sent(0)
    assert hold.update(at(0.5), ARM_SETTLES_NS // 2), "it still settles"
    assert hold.update(at(0.1), ARM_SETTLES_NS)
    assert hold.update(at(0.1 + 0.9 * MOVED_M), 2 * ARM_SETTLES_NS)
    assert not hold.update(at(0.1 + 1.1 * MOVED_M), 3 * ARM_SETTLES_NS)
    assert not hold.held
    hold.on_sent(4 * ARM_SETTLES_NS)
    assert hold.held


def test_an_elbow_that_somebody_moved_while_the_tcp_stayed_is_not_held_any_more() -> None:
    hold = HeldReference(np.zeros(2, bool))
    hold.on_sent(0)
    assert hold.update(at(0.1), ARM_SETTLES_NS)
    assert hold.update(at(0.1, 0.9 * MOVED_RAD), 2 * ARM_SETTLES_NS)
    assert not hold.update(at(0.1, 1.1 * MOVED_RAD), 3 * ARM_SETTLES_NS)
