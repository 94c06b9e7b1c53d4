"""The arm of a ROS 2 robot, turn by turn: a session of its own, and time is what a test says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from ros2_peer import FINGERS, GOAL, Ros2Peer
from ros2_rig import write_profile

from vla_zenoh.codec import header as header_codec
from vla_zenoh.codec import records
from vla_zenoh.control.arm_guard import UNHEEDED_NS
from vla_zenoh.control.so3 import quat_from_rotation
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.nodes import slots
from vla_zenoh.nodes.lead import STALLED_NS
from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.ros2 import hearing
from vla_zenoh.nodes.ros2.arm import Arm
from vla_zenoh.nodes.ros2.link import Link
from vla_zenoh.profile import load_profile
from vla_zenoh.types import (
    FloatArray,
    GripperState,
    Header,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

TICK_S, RAMP_S = 0.004, 0.1
TICK_NS = 4_000_000
SPEED_M_S = 0.2
STEP_M = 2e-4
SAG_RAD = 0.01
SAME_M = 1e-6
UNTURNED = np.array([0.0, 0.0, 0.0, 1.0])
TOPIC = "/panda/panda_cartesian_impedance_controller/desired_pose"
ALONE = """{
  mode: "peer", scouting: {multicast: {enabled: false}}, listen: {endpoints: []}
}"""
JOINT_GOALS = """\
  joint_command: {topic: /goal, type: trajectory_msgs/msg/JointTrajectory}
robot: {command: joint}
"""


@dataclass
class Turns:
    """An arm, and what is heard of it: all within one process, at once."""

    arm: Arm
    node: Node
    peer: Ros2Peer
    session: zenoh.Session
    goals: list[Any]
    states: dict[type, list[Any]]
    joints_rad: FloatArray = field(default_factory=lambda: HOME_RAD.copy())
    mono_ns: int = 0
    wall_ns: int = 10**18
    seq: int = 0
    moved_s: float = 0.0

    def joint_states(self, velocity: float = 0.0) -> None:
        fields: dict[str, Any] = {
            "header": self.peer.header(self.wall_ns),
            "name": [*ARM_JOINTS, *FINGERS],
            "position": np.array([*self.joints_rad, 0.04, 0.04]),
            "velocity": np.full(9, velocity),
            "effort": np.zeros(9),
        }
        self.peer.put("/joint_states", self.peer.message("sensor_msgs/msg/JointState", **fields))

    def turn(self, stall_s: float = 0.0, *, clock_s: float = 0.0) -> None:
        self.mono_ns += TICK_NS
        self.wall_ns += TICK_NS + round(clock_s * 1e9)
        self.joint_states()
        self.arm.turn(self.wall_ns, self.mono_ns, stall_s)

    def sleep(self, duration_s: float) -> None:
        for ns in ("mono_ns", "wall_ns"):
            setattr(self, ns, getattr(self, ns) + round(duration_s * 1e9))

    def put(self, record: Any, source: str = "command#1") -> None:
        self.seq += 1
        keys = self.node.keys
        key = keys.command_joint if isinstance(record, JointCommand) else keys.command_pose
        header = header_codec.encode(Header(self.wall_ns, self.seq, source))
        self.session.put(key, records.encode(record), attachment=header)

    def up(self, *, moves: bool = True) -> None:
        """A command upwards from home, `moved_s` after it began at rest."""
        self.moved_s += TICK_S * moves
        ramp_s = min(self.moved_s, RAMP_S)
        way_m = SPEED_M_S * (ramp_s * ramp_s / (2 * RAMP_S) + self.moved_s - ramp_s)
        speed = SPEED_M_S * ramp_s / RAMP_S
        home = panda().forward(HOME_RAD)
        at_m, quat = home.position_m + (0.0, 0.0, way_m), quat_from_rotation(home.rotation)
        change = SPEED_M_S / RAMP_S if self.moved_s < RAMP_S else 0.0
        twist, acceleration = np.zeros(6), np.zeros(6)
        twist[2], acceleration[2] = speed, change
        self.put(PoseCommand(at_m, quat, twist, acceleration, at_m, quat, "active"))

    def rise(self, duration_s: float = 0.4) -> None:
        for _ in range(round(duration_s / TICK_S)):
            self.up()
            self.turn()
        assert self.arm.detail()["following"]

    @property
    def heights_m(self) -> FloatArray:
        return np.array([goal.pose.position.z for goal in self.goals])

    def newest(self, kind: type) -> Any:
        return self.states[kind][-1]

    def refused(self, reason: str) -> int:
        return self.node.counters[f"refused.{reason}"]


@pytest.fixture
def turns(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Turns]:
    more = getattr(request, "param", "")
    profile = load_profile(str(write_profile(tmp_path, more=more)))
    assert profile.ros2 is not None
    with zenoh.open(zenoh.Config.from_json5(ALONE)) as session:
        node = Node("ros2", profile, session)
        link = Link(session, profile.ros2, Messages("jazzy"), "vla_panda")
        goals: list[Any] = []
        peer = Ros2Peer(session)
        peer.on(TOPIC, GOAL, goals.append)
        peer.on("/goal", "trajectory_msgs/msg/JointTrajectory", goals.append)
        arm = Arm(node, link, Messages("jazzy"), profile.ros2, lambda: (False, None, False))
        states: dict[type, list[Any]] = {}
        keys, subscribers = node.keys, []
        for key, kind in (
            (keys.state_joint, JointState),
            (keys.state_pose, PoseState),
            (keys.state_gripper, GripperState),
        ):
            heard = states.setdefault(kind, [])

            def keep(sample: zenoh.Sample, kind: type = kind, heard: list[Any] = heard) -> None:
                heard.append(records.decode(kind, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(keep, indirect=False)
            subscribers.append(session.declare_subscriber(key, handler))
        robot = Turns(arm, node, peer, session, goals, states, mono_ns=10**12)
        clock = SimpleNamespace(monotonic_ns=lambda: robot.mono_ns)
        for module in (slots, hearing):
            monkeypatch.setattr(module, "time", clock)
        robot.turn()
        yield robot
        peer.close()
        link.close()
        node.close()


def steps_m(turns: Turns) -> FloatArray:
    return np.diff(turns.heights_m)


# -- a loop that stands still -----------------------------------------------------------------
@pytest.mark.parametrize("stall_s", [0.4, 10.0])
def test_after_a_stall_it_stands_where_it_sent_the_arm_last_and_says_that_it_is_not_ready(
    turns: Turns, stall_s: float
) -> None:
    turns.rise()
    sent = len(turns.goals)
    turns.sleep(stall_s)
    for _ in range(30):  # what came meanwhile
        turns.up()
    turns.turn(stall_s)
    assert turns.refused("pose_stalled") == 30
    assert turns.arm.lead.stalls == 1
    for _ in range(STALLED_NS // TICK_NS - 1):
        turns.up()
        turns.turn()
        assert turns.newest(GripperState).mode == "stalled"
    for _ in range(100):
        turns.up()
        turns.turn()
    assert len(turns.goals) == sent, "nobody is led on by an old motion"
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
    for _ in range(90):
        turns.turn()
    assert turns.arm.state == "braking"
    sent = len(turns.goals)
    turns.sleep(10.0)
    turns.turn(10.0)
    assert len(turns.goals) == sent


@pytest.mark.parametrize("stall_s", [0.012, 0.06])
def test_a_late_turn_goes_on_from_what_was_sent_last(turns: Turns, stall_s: float) -> None:
    turns.rise()
    turns.sleep(stall_s)
    for _ in range(round(stall_s / TICK_S)):
        turns.up()
    turns.turn(stall_s)
    turns.rise(0.6)
    assert turns.arm.lead.stalls == 0
    assert steps_m(turns)[30:].min() > 0.5 * SPEED_M_S * TICK_S
    assert np.abs(np.diff(steps_m(turns))).max() < STEP_M
    home_m = panda().forward(HOME_RAD).position_m[2]
    asked_m = home_m + SPEED_M_S * (turns.moved_s + TICK_S - RAMP_S / 2)
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
    for _ in range(90):
        turns.turn()
    assert turns.arm.state == "braking", "and silence is noticed in time"


# -- what is taken ----------------------------------------------------------------------------
def test_joint_states_that_are_finite_and_no_arms_are_refused_and_the_loop_goes_on(
    turns: Turns,
) -> None:
    heard = len(turns.states[PoseState])
    turns.sleep(0.02)
    turns.joint_states(velocity=1e308)
    turns.arm.turn(turns.wall_ns, turns.mono_ns)
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
    assert not turns.arm.detail()["held"]
    turns.seq = 0
    turns.up(moves=False)
    turns.turn()
    assert turns.refused("pose_replayed") == 1
    turns.seq = 10
    turns.up(moves=False)
    turns.turn()
    assert turns.arm.detail()["following"]


@pytest.mark.parametrize("turns", [JOINT_GOALS], indirect=True)
def test_where_joints_are_held_the_reference_of_the_tcp_is_theirs(turns: Turns) -> None:
    still = np.zeros(len(ARM_JOINTS))
    turns.put(JointCommand(ARM_JOINTS, HOME_RAD, still, still, "active"))
    turns.turn()
    turns.joints_rad = HOME_RAD + SAG_RAD
    for _ in range(10):
        turns.turn()
    pose: PoseState = turns.newest(PoseState)
    held_m = panda().forward(HOME_RAD).position_m
    assert pose.reference_position_m is not None
    np.testing.assert_allclose(pose.reference_position_m, held_m, atol=SAME_M)
    assert np.linalg.norm(pose.position_m - held_m) > 1e-3
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
