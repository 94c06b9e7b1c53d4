"""The arm of a ROS 2 robot, turn by turn: a session of its own, and time is what a test says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from panda_arm import ARM_JOINTS, HOME_RAD
from ros2_turns import HOME, RAMP_S, SPEED_M_S, TICK_NS, TICK_S, Turns, ros2_turns

from vla_zenoh.guard.arm_guard import UNHEEDED_NS
from vla_zenoh.robots.arm import STALLED_NS
from vla_zenoh.types import GripperState, JointCommand, JointState, PoseCommand, PoseState

SILENT_TICKS = round(0.36 / TICK_S)
"""A little longer than a command may be late."""
STEP_M = 2e-4
SAG_RAD = 0.01
SAME_M = 1e-6
UNTURNED = np.array([0.0, 0.0, 0.0, 1.0])
JOINT_GOALS = """\
  joint_command: {topic: /goal, type: trajectory_msgs/msg/JointTrajectory}
robot: {command: joint}
"""


@pytest.fixture
def turns(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Turns]:
    with ros2_turns(tmp_path, monkeypatch, getattr(request, "param", "")) as turns:
        yield turns


# -- a loop that stands still -----------------------------------------------------------------
@pytest.mark.parametrize("stall_s", [0.4, 10.0])
def test_after_a_stall_it_stands_where_it_sent_the_arm_last_and_says_that_it_is_not_ready(
    turns: Turns, stall_s: float
) -> None:
    turns.rise()
    # Once more at rest; after a long one somebody else may have moved the arm.
    sent = len(turns.goals) + (stall_s < 0.5)
    turns.sleep(stall_s)
    for _ in range(30):  # what came meanwhile
        turns.up()
    turns.turn(stall_s)
    assert turns.refused("pose_stalled") == 30
    assert turns.arm.stalls == 1
    for _ in range(STALLED_NS // TICK_NS - 1):
        turns.up()
        turns.turn()
        assert turns.newest(GripperState).mode == "stalled"
    assert turns.refused("pose_stalled") == 30 + STALLED_NS // TICK_NS - 1
    for _ in range(30):
        turns.up()
        turns.turn()
    assert len(turns.goals) == sent, "nobody is led on by an old motion"
    assert np.ptp(turns.heights_m[-2:]) < (SAME_M if stall_s < 0.5 else STEP_M * 10)
    assert turns.newest(GripperState).mode == "unheeded", "and who writes it hears of that"
    for _ in range(UNHEEDED_NS // TICK_NS + 2):
        turns.turn()
    assert turns.newest(GripperState).mode == "ready"
    held = turns.newest(PoseState).reference_position_m
    if stall_s > 0.5:
        assert held is None, "somebody else may have moved it meanwhile"
    else:
        assert held[2] == pytest.approx(turns.heights_m[-1], abs=SAME_M)


def test_a_brake_that_was_under_way_is_not_gone_on_with_after_a_stall(turns: Turns) -> None:
    turns.rise()
    for _ in range(SILENT_TICKS):
        turns.turn()
    assert turns.arm.state == "braking"
    sent = len(turns.goals)
    turns.sleep(10.0)
    turns.turn(10.0)
    assert len(turns.goals) == sent


@pytest.mark.parametrize("stall_s", [0.016, 0.064])
def test_a_late_turn_goes_on_from_what_was_sent_last(turns: Turns, stall_s: float) -> None:
    turns.rise()
    turns.sleep(stall_s)
    for _ in range(round(stall_s / TICK_S)):
        turns.up()
    turns.turn(stall_s)
    turns.rise(0.6)
    assert turns.arm.stalls == 0
    assert turns.steps_m[50:].min() > 0.5 * SPEED_M_S * TICK_S
    assert np.abs(np.diff(turns.steps_m)).max() < STEP_M
    asked_m = HOME.position_m[2] + SPEED_M_S * (turns.moved_s + TICK_S - RAMP_S / 2)
    assert turns.heights_m[-1] == pytest.approx(asked_m, abs=STEP_M)


# -- clocks -----------------------------------------------------------------------------------
@pytest.mark.parametrize("step_s", [-100.0, 100.0])
def test_a_wall_clock_that_is_set_silences_nobody(turns: Turns, step_s: float) -> None:
    turns.rise()
    turns.turn(clock_s=step_s)
    heard = len(turns.states[PoseState])
    turns.rise(0.2)
    assert len(turns.states[PoseState]) > heard + 20
    assert turns.arm.state == "running"
    for _ in range(SILENT_TICKS):
        turns.turn()
    assert turns.arm.state == "braking", "and silence is noticed in time"


# -- what is taken ----------------------------------------------------------------------------
def test_joint_states_that_are_finite_and_no_arms_are_refused_and_the_loop_goes_on(
    turns: Turns,
) -> None:
    heard = len(turns.states[PoseState])
    turns.sleep(0.02)
    turns.joint_states(velocity=1e308)
    turns.step()
    assert turns.refused("invalid") == 1
    assert len(turns.states[PoseState]) == heard
    turns.sleep(0.02)
    turns.turn()
    assert len(turns.states[PoseState]) == heard + 1


def test_what_was_heard_before_the_arm_was_moved_by_somebody_else_is_not_new_after_it(
    turns: Turns,
) -> None:
    for _ in range(10):
        turns.up(moves=False)
        turns.turn()
    for _ in range(100):
        turns.turn()
    turns.turn(10.0)
    assert not turns.arm.holds
    turns.seq = 0
    turns.up(moves=False)
    turns.turn()
    assert turns.refused("pose_replayed") == 1
    turns.seq = 10
    turns.up(moves=False)
    turns.turn()
    assert turns.arm.guard.following


@pytest.mark.parametrize("turns", [JOINT_GOALS], indirect=True)
def test_where_joints_are_held_the_reference_of_the_tcp_is_theirs(turns: Turns) -> None:
    still = np.zeros(len(ARM_JOINTS))
    turns.put(JointCommand(ARM_JOINTS, HOME_RAD, still, still, "active"))
    turns.turn()
    turns.joints_rad = HOME_RAD + SAG_RAD
    for _ in range(10):
        turns.turn()
    pose: PoseState = turns.newest(PoseState)
    assert pose.reference_position_m is not None
    np.testing.assert_allclose(pose.reference_position_m, HOME.position_m, atol=SAME_M)
    assert np.linalg.norm(pose.position_m - HOME.position_m) > 1e-3
    np.testing.assert_array_equal(turns.newest(JointState).reference_rad, HOME_RAD)


# -- a beginning that is lost -----------------------------------------------------------------
def test_a_stream_of_poses_whose_beginning_was_lost_is_told_to_who_writes_it(
    turns: Turns,
) -> None:
    turns.moved_s = RAMP_S
    for _ in range(10):
        turns.up()
        turns.turn()
    assert turns.refused("pose_jump") == 10
    assert turns.goals == []
    assert turns.newest(GripperState).mode == turns.arm.state == "unheeded"


@pytest.mark.parametrize("turns", [JOINT_GOALS], indirect=True)
def test_a_stream_of_joints_whose_beginning_was_lost_is_told_to_who_writes_it(
    turns: Turns,
) -> None:
    still, elbow_rad = np.zeros(len(ARM_JOINTS)), HOME_RAD.copy()
    for _ in range(10):
        elbow_rad[2] += 0.006  # the TCP stands nearly still
        turns.put(JointCommand(ARM_JOINTS, elbow_rad, still, still, "active"))
        turns.turn()
    assert turns.refused("joint_jump") == 10
    assert turns.newest(GripperState).mode == turns.arm.state == "unheeded"


def test_no_stranger_makes_an_arm_that_is_followed_unready(turns: Turns) -> None:
    turns.rise()
    elsewhere = PoseCommand(
        np.zeros(3), UNTURNED, np.zeros(6), np.zeros(6), np.zeros(3), UNTURNED, "active"
    )
    for _ in range(20):
        turns.put(elsewhere, "stranger#1")
        turns.up()
        turns.turn()
    assert turns.refused("pose_foreign") == 20
    assert turns.newest(GripperState).mode == "ready"
