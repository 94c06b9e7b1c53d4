"""One arm on the page: its newest states and commands, and what is drawn of them."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import ReceivedSample, ZenohRing, bytes_of, header_of
from vla_zenoh.codec import records
from vla_zenoh.codec.settings import decode_held, encode_text
from vla_zenoh.errors import CodecError, RecordError, SpecError, VlaZenohError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, rotation_from_quat
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    HeldBox,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)
from vla_zenoh_web.arm import ArmLines, Line, corners_of, rounded

SILENT_S = 1.0
GOALS = 100
CHUNK_S = 2.0
"""A chunk that none followed for this long is drawn no more."""


class PartStreams:
    """Streams of a part of a robot, or of a robot that is one arm. Belongs to one thread.

    Attributes:
        no_arm: why the arm cannot be drawn; empty: it can.
    """

    def __init__(self, profile: Profile, session: zenoh.Session, counters: Counter[str]) -> None:
        self._name, self._counters, keys = profile.part, counters, profile.keys
        self._rings: dict[type[Any], ZenohRing] = {}
        self._subscribers: list[Any] = []
        for kind, key in (
            (PoseState, keys.state_pose),
            (JointState, keys.state_joint),
            (GripperState, keys.state_gripper),
            (PoseCommand, keys.command_pose),
            (JointCommand, keys.command_joint),
        ):
            ring = self._rings[kind] = ZenohRing(1)
            self._subscribers.append(ring.subscribe(session, key))
        self._newest: dict[type[Any], tuple[Any, float]] = {}
        self._goals: deque[tuple[int, Pose]] = deque(maxlen=GOALS)
        self._chunk: tuple[Line, float] = ([], -CHUNK_S)
        self._lines: ArmLines | None = None
        self.no_arm = ""
        try:
            self._lines = ArmLines(make_kinematics(profile))
        except VlaZenohError as error:
            self.no_arm = str(error)

    def poll(self, now_s: float) -> None:
        """Decode the newest sample of each stream."""
        for kind, ring in self._rings.items():
            for sample in ring.drain():
                self._take(kind, sample, now_s)
            for rejected in ring.pop_rejected():
                self._counters["bad_sample"] += rejected.times

    def _take(self, kind: type[Any], sample: ReceivedSample, now_s: float) -> None:
        try:
            header = header_of(sample.sample)
            record = records.decode(kind, bytes_of(sample.sample.payload))
        except CodecError:
            self._counters["bad_sample"] += 1
            return
        self._newest[kind] = (record, now_s)
        if kind is PoseCommand:
            goal = Pose(record.goal_position_m, rotation_from_quat(record.goal_quat_xyzw))
            self._goals.append((header.stamp_wall_ns, goal))

    def take_chunk(self, chunk: ActionChunk, spec: ModelSpec, now_s: float) -> None:
        """Draw a chunk of `spec` from the goal in force at its observation.

        Raises:
            RecordError: it does not fit the spec, or the spec this arm.
        """
        measured, lines = self._recent(PoseState, now_s), self._lines
        if measured is None or lines is None:
            return
        try:
            action = spec.action.of(self._name)
        except SpecError as error:
            raise RecordError(str(error)) from error
        steps = chunk.steps
        if steps.shape[1] == spec.action.dimension:
            steps = steps[:, spec.action.columns(self._name)]
        start = Pose(measured.position_m, rotation_from_quat(measured.quat_xyzw))
        if action.anchor == "goal":
            seen_ns = chunk.observation_stamp_ns
            before = (pose for stamp_ns, pose in reversed(self._goals) if stamp_ns <= seen_ns)
            start = next(before, start)
        joints = self._recent(JointState, now_s)
        self._chunk = (lines.chunk(steps, action, start, joints), now_s)

    def _recent(self, kind: type[Any], now_s: float) -> Any:
        """The newest record of a stream, None if it is silent."""
        record, at_s = self._newest.get(kind, (None, 0.0))
        return record if now_s - at_s < SILENT_S else None

    def described(self, now_s: float, holds: str) -> dict[str, Any]:
        """Positions for the picture, m in the base frame of this arm, its speed, its gripper.

        What is unknown is absent.

        Args:
            holds: the box that its gripper is said to hold; empty: none.
        """
        pose, joints = self._recent(PoseState, now_s), self._recent(JointState, now_s)
        found: dict[str, Any] = {}
        if pose is not None:
            found["measured_m"] = rounded([pose.position_m])[0]
            found["speed_m_s"] = round(float(np.linalg.norm(pose.twist[:3])), 4)
        box = decode_held(encode_text(holds))
        if isinstance(box, HeldBox):
            found["holds"] = holds
            if pose is not None:
                tcp = Pose(pose.position_m, rotation_from_quat(pose.quat_xyzw))
                found["held_m"] = corners_of(box, tcp)
        command = self._recent(PoseCommand, now_s)
        if command is not None:
            found["command_m"] = rounded([command.position_m])[0]
            found["goal_m"] = rounded([command.goal_position_m])[0]
        gripper = self._recent(GripperState, now_s)
        if gripper is not None:
            width_m = gripper.width_m
            found["width_m"] = None if width_m is None else round(width_m, 4)
            found["holding"] = gripper.holding
        if now_s - self._chunk[1] < CHUNK_S:
            found["chunk_m"] = self._chunk[0]
        try:
            if self._lines is not None and joints is not None:
                found["links_m"] = self._lines.links_of(joints)
            by_joints = self._recent(JointCommand, now_s)
            if self._lines is not None and by_joints is not None:
                found["command_m"] = self._lines.tcp(by_joints.names, by_joints.position_rad)
        except RecordError:
            self._counters["bad_sample"] += 1
        return found

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
