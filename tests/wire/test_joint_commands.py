"""The simulator's process on a real bus: joint commands move its arm, everything else does not."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import await_match, free_endpoint, until

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import message, records
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import (
    FloatArray,
    Header,
    JointCommand,
    JointState,
    NodeStatus,
    PoseCommand,
    PoseState,
)

pytestmark = pytest.mark.long

START_PATIENCE_S, END_PATIENCE_S = 30.0, 10.0
PERIOD_S = 0.004
WAY_RAD = np.array([0.3, 0.1, -0.2, 0.2, 0.3, -0.2, 0.4])
WAY_S = 2.0
REACHED_RAD = 2e-3
FOLLOWED_RAD = 0.01  # a reader sees state and command some milliseconds apart
STILL_RAD_S = 5e-3
UNMOVED_RAD = 2e-3
HANDED_OVER_M = 2e-4

PROFILE = """\
extends: panda_sim
robot: {{command: joint}}
timing: {{command_timeout_s: 1.0}}  # the writer is a test on a busy machine
session:
  listen: [{endpoint}]
  connect: [{endpoint}]
"""


@dataclass
class Robot:
    """The simulator's process as a client sees it."""

    profile: Profile
    session: zenoh.Session
    joints: list[JointState] = field(default_factory=list)
    poses: list[PoseState] = field(default_factory=list)
    statuses: list[NodeStatus] = field(default_factory=list)
    seq: int = 0

    def put(
        self, key: str, payload: bytes, *, source: str = "test#1", stamp_ns: int | None = None
    ) -> None:
        self.seq += 1
        header = Header(time.time_ns() if stamp_ns is None else stamp_ns, self.seq, source)
        self.session.put(key, payload, attachment=records.encode_header(header))

    def put_joints(
        self, position: FloatArray, velocity: FloatArray | None = None, **how: Any
    ) -> None:
        names = self.profile.robot.arm_joints
        speed = np.zeros(7) if velocity is None else velocity
        command = JointCommand(names, position, speed, np.zeros(7), "active")
        self.put(self.profile.keys.command_joint, records.encode(command), **how)

    def put_pose(self, state: PoseState) -> None:
        assert state.reference_position_m is not None
        assert state.reference_quat_xyzw is not None
        where = (state.reference_position_m, state.reference_quat_xyzw)
        command = PoseCommand(*where, np.zeros(6), np.zeros(6), *where, "active")
        self.put(self.profile.keys.command_pose, records.encode(command))

    @property
    def now_rad(self) -> FloatArray:
        return self.joints[-1].position_rad

    def refused(self, reason: str) -> int:
        return self.statuses[-1].counters.get(f"refused.{reason}", 0) if self.statuses else 0

    def detail(self, name: str) -> Any:
        return self.statuses[-1].detail.get(name) if self.statuses else None

    def nobody_is_followed(self) -> None:
        """Until the streams of an earlier test have ended, and the arm stands."""
        count = len(self.statuses)
        until(
            "nobody followed and the arm at rest",
            lambda: (
                len(self.statuses) > count
                and not self.detail("following")
                and np.abs(self.joints[-1].velocity_rad_s).max() < STILL_RAD_S
            ),
        )


def listen(session: zenoh.Session, key: str, kind: type, heard: list[Any]) -> Any:
    def keep(sample: zenoh.Sample) -> None:
        heard.append(records.decode(kind, sample.payload.to_bytes()))

    return session.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    path = tmp_path_factory.mktemp("joint") / "joint.yaml"
    path.write_text(PROFILE.format(endpoint=free_endpoint()))
    profile = load_profile(str(path))
    keys = profile.keys
    with open_session(profile.session, mode="router"), open_session(profile.session) as session:
        robot = Robot(profile, session)
        subscribers = [
            listen(session, keys.state_joint, JointState, robot.joints),
            listen(session, keys.state_pose, PoseState, robot.poses),
            listen(session, keys.status("sim"), NodeStatus, robot.statuses),
        ]
        with simulator(path) as process:
            until("a first state", lambda: robot.joints and robot.statuses, START_PATIENCE_S)
            await_match(session, keys.command_joint)
            await_match(session, keys.command_pose)
            yield robot
            assert process.poll() is None, "the simulator died"
        assert len(subscribers) == 3


@contextmanager
def simulator(profile: Path) -> Iterator[subprocess.Popen[bytes]]:
    """``vla-zenoh node sim`` in a process of its own."""
    words = [sys.executable, "-m", "vla_zenoh", "node", "sim", "--profile", str(profile)]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(END_PATIENCE_S)
        finally:
            process.kill()
            process.wait()


def stream(
    robot: Robot, path: Callable[[float], tuple[FloatArray, FloatArray]], duration_s: float
) -> None:
    """Put a joint command every 4 ms, each stamped with the time it is for."""
    begin = time.time_ns()
    while (elapsed_s := (time.time_ns() - begin) / 1e9) < duration_s:
        robot.put_joints(*path(elapsed_s), stamp_ns=begin + int(elapsed_s * 1e9))
        time.sleep(PERIOD_S)


def way(start: FloatArray, by: FloatArray) -> Callable[[float], tuple[FloatArray, FloatArray]]:
    """From rest to rest within `WAY_S`, and there from then on."""

    def at(time_s: float) -> tuple[FloatArray, FloatArray]:
        s = min(time_s / WAY_S, 1.0)
        speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / WAY_S
        return start + (10 * s**3 - 15 * s**4 + 6 * s**5) * by, speed * by

    return at


def test_a_session_that_puts_joint_commands_moves_the_arm(robot: Robot) -> None:
    robot.nobody_is_followed()
    start, silences = robot.now_rad.copy(), robot.statuses[-1].counters["sim.stream_silences"]
    first = len(robot.joints)
    stream(robot, way(start, WAY_RAD), WAY_S + 1.0)
    assert robot.detail("command") == "joint"
    error = np.abs(robot.now_rad - (start + WAY_RAD))
    assert error.max() < REACHED_RAD
    for state in robot.joints[first:]:
        assert state.reference_rad is not None
        assert np.abs(state.position_rad - state.reference_rad).max() < FOLLOWED_RAD
    robot.nobody_is_followed()
    assert robot.statuses[-1].counters["sim.stream_silences"] == silences
    pose = robot.poses[-1]
    assert pose.reference_position_m is not None
    assert np.linalg.norm(pose.position_m - pose.reference_position_m) < 1e-3


def test_silence_in_motion_brakes_the_arm(robot: Robot) -> None:
    robot.nobody_is_followed()
    silences = robot.statuses[-1].counters["sim.stream_silences"]
    stream(robot, way(robot.now_rad.copy(), -WAY_RAD), WAY_S / 2)
    assert np.abs(robot.joints[-1].velocity_rad_s).max() > 0.1
    robot.nobody_is_followed()
    assert robot.statuses[-1].counters["sim.stream_silences"] == silences + 1


HOME = np.zeros(7)
NAMES = ("a", "b", "c", "d", "e", "f", "g")


def forged(**fields: Any) -> bytes:
    whole = JointCommand(NAMES, HOME, HOME, HOME, "active")
    return message.pack(message.unpack(records.encode(whole)) | fields)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "malformed"),
        (b"\xff\x00nonsense", "malformed"),
        (message.pack({"names": ["a"]}), "malformed"),
        (forged(position_rad=np.full(7, np.nan)), "invalid"),
        (forged(velocity_rad_s=np.zeros(3)), "invalid"),
        (forged(), "joint_names"),
    ],
    ids=["empty", "nonsense", "too little", "not finite", "too short", "other joints"],
)
def test_garbage_on_the_joint_key_is_refused_and_counted(
    robot: Robot, payload: bytes, reason: str
) -> None:
    before, counted = robot.now_rad.copy(), robot.refused(reason)
    robot.put(robot.profile.keys.command_joint, payload)
    until(f"{reason} counted", lambda: robot.refused(reason) > counted)
    assert np.abs(robot.now_rad - before).max() < UNMOVED_RAD


def test_a_command_without_a_header_is_refused_and_counted(robot: Robot) -> None:
    counted = robot.refused("no_header")
    robot.session.put(robot.profile.keys.command_joint, forged())
    until("no_header counted", lambda: robot.refused("no_header") > counted)


def test_a_jump_and_a_speed_no_joint_has_are_refused_and_counted(robot: Robot) -> None:
    before = robot.now_rad.copy()
    jumps, fast = robot.refused("joint_jump"), robot.refused("joint_too_fast")
    robot.put_joints(before + 0.3)
    robot.put_joints(before, np.full(7, 3.0))
    until("a jump", lambda: robot.refused("joint_jump") > jumps)
    until("too fast", lambda: robot.refused("joint_too_fast") > fast)
    assert np.abs(robot.now_rad - before).max() < UNMOVED_RAD


def test_while_joints_are_followed_a_pose_is_refused_and_afterwards_it_moves_nothing(
    robot: Robot,
) -> None:
    robot.nobody_is_followed()
    start, refused = robot.now_rad.copy(), robot.refused("pose_other_mode")
    ended = threading.Event()

    def hold() -> None:
        while not ended.is_set():
            robot.put_joints(start)
            time.sleep(PERIOD_S)

    holding = threading.Thread(target=hold)
    holding.start()
    try:
        until("joints followed", lambda: robot.detail("following"))
        robot.put_pose(robot.poses[-1])
        until("other_mode", lambda: robot.refused("pose_other_mode") > refused)
        assert robot.detail("command") == "joint"
    finally:
        ended.set()
        holding.join()
    robot.nobody_is_followed()
    first, before = len(robot.poses), robot.poses[-1].position_m
    robot.put_pose(robot.poses[-1])
    until("the pose is followed", lambda: robot.detail("command") == "pose")
    robot.nobody_is_followed()
    way_m = [float(np.linalg.norm(state.position_m - before)) for state in robot.poses[first:]]
    assert len(way_m) > 20
    assert max(way_m) < HANDED_OVER_M
    robot.put_joints(robot.now_rad)
    until("joints again", lambda: robot.detail("command") == "joint")
