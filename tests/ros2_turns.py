"""The node ``ros2``, tick by tick: in one process, at the time a test says."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import routed_session
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from ros2_peer import FINGERS, GOAL, Ros2Peer
from ros2_rig import write_profile
from vla_zenoh_ros2.driver import Ros2Driver

from vla_zenoh.bus import buffers as slots
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.node import RobotNode
from vla_zenoh.types import (
    Event,
    FloatArray,
    GripperState,
    Header,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

HOME = panda().forward(HOME_RAD)
HOME_QUAT = quat_from_rotation(HOME.rotation)
TICK_S, RAMP_S = 0.008, 0.24
TICK_NS = 8_000_000
SPEED_M_S = 0.2
TOPIC = "/panda/panda_cartesian_impedance_controller/desired_pose"


@dataclass
class Turns:
    """An arm, and what is heard of it: all within one process, at once."""

    robot: RobotNode
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
        self.step(stall_s)

    def step(self, stall_s: float = 0.0) -> None:
        self.robot.driver.poll(self.mono_ns)
        self.arm.begin_step(self.wall_ns, self.mono_ns, stall_s)
        self.arm.end_step(self.mono_ns)

    def sleep(self, duration_s: float) -> None:
        for ns in ("mono_ns", "wall_ns"):
            setattr(self, ns, getattr(self, ns) + round(duration_s * 1e9))

    def put(self, record: Any, source: str = "command#1") -> None:
        self.seq += 1
        keys = self.node.keys
        key = keys.command_joint if isinstance(record, JointCommand) else keys.command_pose
        header = records.encode_header(Header(self.wall_ns, self.seq, source))
        self.session.put(key, records.encode(record), attachment=header)

    def up(self, *, moves: bool = True) -> None:
        """A command upwards from home, `moved_s` after it began at rest."""
        self.moved_s += TICK_S * moves
        begun_s, turn_1_s = min(self.moved_s, RAMP_S), np.pi / RAMP_S
        speed = SPEED_M_S * (1 - np.cos(turn_1_s * begun_s)) / 2
        ramp_m = SPEED_M_S * (begun_s - np.sin(turn_1_s * begun_s) / turn_1_s) / 2
        way_m = ramp_m + SPEED_M_S * (self.moved_s - begun_s)
        at_m, quat = HOME.position_m + (0.0, 0.0, way_m), HOME_QUAT
        change = SPEED_M_S * turn_1_s * np.sin(turn_1_s * begun_s) / 2
        twist, acceleration = np.zeros(6), np.zeros(6)
        twist[2], acceleration[2] = speed, change
        self.put(PoseCommand(at_m, quat, twist, acceleration, at_m, quat, "active"))

    def rise(self, duration_s: float = 0.4) -> None:
        for _ in range(round(duration_s / TICK_S)):
            self.up()
            self.turn()
        assert self.arm.guard.following

    @property
    def heights_m(self) -> FloatArray:
        return np.array([goal.pose.position.z for goal in self.goals])

    @property
    def steps_m(self) -> FloatArray:
        return np.diff(self.heights_m)

    def newest(self, kind: type) -> Any:
        return self.states[kind][-1]

    def refused(self, reason: str) -> int:
        return self.node.counters[f"refused.{reason}"]


@contextmanager
def ros2_turns(folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = "") -> Iterator[Turns]:
    """`more` is YAML that goes on in the profile's section ros2."""
    profile = load_profile(str(write_profile(folder, more=more, command_hz=125)))
    assert profile.ros2 is not None
    with routed_session() as session:
        goals: list[Any] = []
        peer = Ros2Peer(session)
        peer.on(TOPIC, GOAL, goals.append)
        peer.on("/goal", "trajectory_msgs/msg/JointTrajectory", goals.append)
        ros2 = RobotNode(Ros2Driver(profile), session)
        assert ros2.arm is not None
        node, arm = ros2.node, ros2.arm
        states: dict[type, list[Any]] = {}
        keys, subscribers = node.keys, []
        for key, kind in (
            (keys.state_joint, JointState),
            (keys.state_pose, PoseState),
            (keys.state_gripper, GripperState),
            (keys.event("ros2"), Event),
        ):
            heard = states.setdefault(kind, [])

            def keep(sample: zenoh.Sample, kind: type = kind, heard: list[Any] = heard) -> None:
                heard.append(records.decode(kind, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(keep, indirect=False)
            subscribers.append(session.declare_subscriber(key, handler))
        mono_ns = 10**12
        times = {"mono_ns": mono_ns, "wall_ns": node.clock.wall_at(mono_ns)}
        robot = Turns(ros2, arm, node, peer, session, goals, states, **times)
        clock = SimpleNamespace(monotonic_ns=lambda: robot.mono_ns)
        monkeypatch.setattr(slots, "time", clock)
        robot.turn()
        yield robot
        peer.close()
        ros2.driver.close()
        node.close()
