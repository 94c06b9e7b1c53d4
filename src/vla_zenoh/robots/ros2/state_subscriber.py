"""Subscribes to a ROS 2 robot's joint states and external wrench."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile.ros2 import Ros2Profile
from vla_zenoh.robots.joint_reading import JointReading, RobotClock
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.ros2.keys import SENSOR
from vla_zenoh.ros2.messages import Messages
from vla_zenoh.ros2.readers import JOINT_STATE, WRENCH, read
from vla_zenoh.ros2.samples import Wrench
from vla_zenoh.types import FloatArray

BUFFER = 64
WRENCH_TIMEOUT_NS = 200_000_000


class StateSubscriber:
    """State of the arm and gripper from the robot's topics.

    Attributes:
        state: newest joint states of arm and gripper.
        clock: of the robot.
        rate: of joint states.
        received_ns: monotonic time of the newest joint state, None before the first.
    """

    def __init__(
        self,
        node: Node,
        graph: RosGraph,
        messages: Messages,
        ros2: Ros2Profile,
        kinematics: Kinematics,
    ) -> None:
        self._node, self._messages, self._ros2 = node, messages, ros2
        self.state = JointReading(node.profile, kinematics)
        self.clock = RobotClock()
        self.rate = RateMeter()
        self.received_ns: int | None = None
        self._wrench: Wrench | None = None
        topics = dict.fromkeys((ros2.joint_states, ros2.finger_states or ros2.joint_states))
        self._joint_states = [
            graph.subscribe(topic, JOINT_STATE, CallbackRing(BUFFER), SENSOR) for topic in topics
        ]
        self._wrenches = None
        if ros2.wrench is not None:
            self._wrenches = graph.subscribe(ros2.wrench.topic, WRENCH, CallbackRing(4), SENSOR)

    def wrench(self, stamp_ns: int) -> FloatArray | None:
        """(6,) external wrench in N and Nm, None if there is none for that time."""
        found = self._wrench
        if found is None or abs(stamp_ns - found.stamp_ns) > WRENCH_TIMEOUT_NS:
            return None
        return found.wrench

    # -- topics -------------------------------------------------------------------------------
    def _reject(self, topic: str, error: CodecError) -> None:
        self._node.reject(error.reason, f"{topic}: {error}", topic)

    def _decode(self, kind: str, arrival: ReceivedSample) -> Any:
        return read(self._messages, kind, arrival.sample.payload.to_bytes())

    def update(self) -> bool:
        """Process the messages that arrived; whether there is a new state of the arm's joints."""
        self._update_wrench()
        fresh = False
        for buffer in self._joint_states:
            for arrival in buffer.drain():
                try:
                    joints = self._decode(JOINT_STATE, arrival)
                    arrived_ns = self._node.arrival_wall_ns(arrival)
                    if self.state.take(joints, joints.stamp_ns or arrived_ns) is None:
                        continue  # of the fingers alone, or of another robot
                except CodecError as error:
                    self._reject(str(arrival.sample.key_expr), error)
                    continue
                fresh = True
                self.clock.take(joints.stamp_ns, arrived_ns)
                self.received_ns = arrival.mono_ns
                self.rate.tick()
        return fresh

    def _update_wrench(self) -> None:
        if self._wrenches is None or self._ros2.wrench is None:
            return
        frame = self._ros2.wrench.frame or self._node.profile.robot.base_frame
        for arrival in self._wrenches.drain():
            try:
                found: Wrench = self._decode(WRENCH, arrival)
                if found.frame != frame:
                    raise CodecError("frame", f"in frame {found.frame[:60]!r}, wanted {frame!r}")
                if not np.isfinite(found.wrench).all():
                    raise CodecError("invalid", "a wrench that is NaN or infinite")
            except CodecError as error:
                self._reject(self._ros2.wrench.topic, error)
            else:
                stamp_ns = found.stamp_ns or self._node.arrival_wall_ns(arrival)
                self._wrench = found._replace(stamp_ns=stamp_ns)
