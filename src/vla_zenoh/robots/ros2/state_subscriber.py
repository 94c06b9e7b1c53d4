"""What a ROS 2 robot's topics say of its arm: joint states, its transforms, its external wrench."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.joint_reading import JointReading
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.graph import TF, TF_STATIC
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.qos import SENSOR, STATIC_TRANSFORMS
from vla_zenoh.interop.ros2.robot_clock import RobotClock
from vla_zenoh.interop.ros2.samples import Wrench
from vla_zenoh.interop.ros2.topics import joint_state, transforms, wrench
from vla_zenoh.interop.ros2.transform_buffer import TransformBuffer
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile.ros2 import Ros2Profile
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.types import FloatArray

INBOX = 64
WRENCH_PATIENCE_NS = 200_000_000


class StateSubscriber:
    """See the module.

    Args:
        node: on whose behalf.
        link: to the ROS graph.
        messages: of the robot's distribution.
        ros2: the profile's section.
        kinematics: of the arm.

    Attributes:
        state: of arm and gripper, the newest.
        clock: of the robot.
        rate: of joint states.
    """

    def __init__(
        self,
        node: Node,
        link: RosGraph,
        messages: Messages,
        ros2: Ros2Profile,
        kinematics: Kinematics,
    ) -> None:
        self._node, self._messages, self._ros2 = node, messages, ros2
        self.state = JointReading(node.profile, kinematics)
        self.clock = RobotClock()
        self.rate = RateMeter()
        self._heard_ns: int | None = None
        self._wrench: Wrench | None = None
        self._frames = TransformBuffer() if ros2.tcp == "tf" else None
        topics = dict.fromkeys((ros2.joint_states, ros2.finger_states or ros2.joint_states))
        self._joint_slots = [
            link.read(topic, joint_state.TYPE, CallbackRing(INBOX), SENSOR) for topic in topics
        ]
        self._tf_slots = []
        if self._frames is not None:
            self._tf_slots = [
                (link.read(TF, transforms.TYPE, CallbackRing(INBOX), SENSOR), False),
                (
                    link.read(TF_STATIC, transforms.TYPE, CallbackRing(INBOX), STATIC_TRANSFORMS),
                    True,
                ),
            ]
        self._wrench_slot = None
        if ros2.wrench is not None:
            self._wrench_slot = link.read(ros2.wrench.topic, wrench.TYPE, CallbackRing(4), SENSOR)

    @property
    def age_s(self) -> float | None:
        """Of the newest joint state, None before the first."""
        return None if self._heard_ns is None else (time.monotonic_ns() - self._heard_ns) / 1e9

    def take(self) -> bool:
        """Take what arrived; whether the arm's joints are known anew."""
        self._take_transforms()
        self._take_wrench()
        return self._take_joints()

    def tcp(self, stamp_ns: int) -> tuple[Pose | None, FloatArray]:
        """The TCP and its (6,) twist; None where its transforms are not known, or not of then."""
        tcp, twist = self.state.tcp()
        return (tcp if self._frames is None else self._tcp_of(self._frames, stamp_ns)), twist

    def wrench(self, stamp_ns: int) -> FloatArray | None:
        """(6,) external N and Nm, None where none was heard lately."""
        found = self._wrench
        if found is None or abs(stamp_ns - found.stamp_ns) > WRENCH_PATIENCE_NS:
            return None
        return found.wrench

    # -- topics -------------------------------------------------------------------------------
    def _refuse(self, topic: str, error: CodecError) -> None:
        self._node.reject(error.reason, f"{topic}: {error}", topic)

    def _read(self, kind: str, arrival: ReceivedSample) -> Any:
        return table.read(self._messages, kind, arrival.sample.payload.to_bytes())

    def _take_joints(self) -> bool:
        fresh = False
        for slot in self._joint_slots:
            for arrival in slot.drain():
                topic = str(arrival.sample.key_expr)
                try:
                    joints = self._read(joint_state.TYPE, arrival)
                    arrived_ns = self._node.arrival_wall_ns(arrival)
                    if self.state.take(joints, joints.stamp_ns or arrived_ns) is None:
                        continue  # of the fingers alone, or another robot's
                except CodecError as error:
                    self._refuse(topic, error)
                    continue
                fresh = True
                self.clock.take(joints.stamp_ns, arrived_ns)
                self._heard_ns = arrival.mono_ns
                self.rate.tick()
        return fresh

    def _take_transforms(self) -> None:
        for slot, static in self._tf_slots:
            for arrival in slot.drain():
                assert self._frames is not None
                try:
                    self._frames.take(self._read(transforms.TYPE, arrival), static=static)
                except CodecError as error:
                    self._refuse(TF_STATIC if static else TF, error)

    def _take_wrench(self) -> None:
        if self._wrench_slot is None or self._ros2.wrench is None:
            return
        frame = self._ros2.wrench.frame or self._node.profile.robot.base_frame
        for arrival in self._wrench_slot.drain():
            try:
                found: Wrench = self._read(wrench.TYPE, arrival)
                if found.frame != frame:
                    raise CodecError("frame", f"in frame {found.frame[:60]!r}, wanted {frame!r}")
                if not np.isfinite(found.wrench).all():
                    raise CodecError("invalid", "a wrench that is NaN or infinite")
            except CodecError as error:
                self._refuse(self._ros2.wrench.topic, error)
            else:
                stamp_ns = found.stamp_ns or self._node.arrival_wall_ns(arrival)
                self._wrench = found._replace(stamp_ns=stamp_ns)

    def _tcp_of(self, frames: TransformBuffer, stamp_ns: int) -> Pose | None:
        profile = self._node.profile
        found = frames.find(profile.robot.base_frame, profile.robot.tcp_frame)
        if found is None:
            way = f"{profile.robot.base_frame} -> {profile.robot.tcp_frame}"
            self._refuse(TF, CodecError("no_transform", f"{way} is not known"))
            return None
        pose, oldest_ns, newest_ns = found
        behind_s, ahead_s = (stamp_ns - oldest_ns) / 1e9, (newest_ns - stamp_ns) / 1e9
        if max(behind_s, ahead_s) > profile.timing.state_timeout_s:
            why = (
                f"{behind_s:.3f} s behind the joints"
                if behind_s > ahead_s
                else f"{ahead_s:.3f} s ahead of the joints: was a clock set?"
            )
            self._refuse(TF, CodecError("stale", f"the TCP is {why}"))
            return None
        return pose
