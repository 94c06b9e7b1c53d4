"""One arm of a ROS 2 robot: joint states in, set-points out, its gripper."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.control.preflight import clock_remedy
from vla_zenoh.errors import CodecError, ProfileError, RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.nodes.camera.source import STALL_S
from vla_zenoh.profile import Profile
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver
from vla_zenoh.robots.joint_reading import JointReading, RobotClock, SimulatedClock, wall_stamp_ns
from vla_zenoh.types import Event, FloatArray, GripperCommand, GripperState, JointState
from vla_zenoh.types.records import JointReference, Joints, PoseReference
from vla_zenoh_ros2.gripper import Gripper
from vla_zenoh_ros2.keys import COMMAND, SENSOR
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import JOINT_STATE, WRENCH, Wrench, read
from vla_zenoh_ros2.ros_graph import RosGraph
from vla_zenoh_ros2.writers import Stamp, Write, joint_writer, pose_writer

NAME = "ros2"
FINGERS_TIMEOUT_NS = 1_000_000_000
"""Gripper nodes publish more slowly than arms."""
BUFFER = 64
WRENCH_TIMEOUT_NS = 200_000_000
LEAD_PERIODS = 2
"""A trajectory's point lies this many command periods ahead."""


class Posture(NamedTuple):
    """Joints of an arm, in the order of the chain, and their stamp by the robot's clock."""

    stamp_ns: int
    position_rad: FloatArray


class Ros2Arm(RobotDriver):
    """One arm of a ROS 2 robot, with the topics of its own profile.

    It is in the ROS graph once it `join`s it, and is moved once it is attached to an `Arm`.
    `sim_clock` translates its stamps, None if they are of real time. For other threads: `posture`
    has the newest joints, `setpoint` the newest reference, with when it was sent (monotonic, ns).

    Raises:
        ProfileError: ros2 lacks the topic for its commands, or its type cannot carry them.
    """

    name = NAME

    def __init__(self, profile: Profile, messages: Messages) -> None:
        super().__init__(profile)
        assert profile.ros2 is not None
        ros2 = self._ros2 = profile.ros2
        self._messages = messages
        output = ros2.joint_command if profile.robot.command == "joint" else ros2.pose_command
        if output is None:
            raise ProfileError(f"ros2 lacks {profile.robot.command}_command")
        self._output, self._frame = output, output.frame or profile.robot.base_frame
        self._write = self._writing()
        if ros2.gripper is None:
            self.no_gripper = "the profile has no ros2.gripper"
        self.silent_why = f"nothing on {ros2.joint_states}; is the robot or the bridge gone?"
        self.sim_clock = SimulatedClock() if ros2.use_sim_time else None
        self._clock_reported = self._fingers_lost = False
        self.posture: Posture | None = None
        self.setpoint: tuple[int, PoseReference | JointReference] | None = None
        self._read_ns: int | None = None
        self._arm: Arm | None = None

    def _writing(self) -> Write:
        """Function that fills a message of the output's type, or a `ProfileError`."""
        if self.profile.robot.command == "joint":
            lead_ns = round(LEAD_PERIODS * self.period_s * 1e9)
            return joint_writer(self._messages, self._output.type, lead_ns)
        return pose_writer(self._messages, self._output.type, np.array(self.profile.robot.home_rad))

    def join(self, node: Node, graph: RosGraph, blocked: Callable[[], str]) -> None:
        """Subscribe to its states and announce its commands; see `Gripper` for `blocked`."""
        self._node, profile, messages = node, self.profile, self._messages
        signs = zip(profile.robot.finger_joints, self.kinematics.finger_signs, strict=True)
        self.gripper = Gripper(node, graph, messages, profile, self._width_m, blocked, dict(signs))
        self.states = StateSubscriber(
            node, graph, messages, profile, self.kinematics, self.sim_clock
        )
        self._writer = graph.publisher(self._output.topic, self._output.type, COMMAND)

    def attach(self, node: Node, arm: Arm) -> None:
        super().attach(node, arm)
        self._arm = arm

    @property
    def silent_topics(self) -> list[str]:
        """Topics of its states on which nothing comes."""
        last_ns = self.states.received_ns
        silent = last_ns is None or time.monotonic_ns() - last_ns > STALL_S * 1e9
        return [self._ros2.joint_states] if silent else []

    # -- one tick -----------------------------------------------------------------------------
    def poll(self, mono_ns: int) -> None:
        """Handle answers of the gripper."""
        # With no subscriber a set-point is dropped: then no controller holds it.
        heard = self._writer.has_subscribers
        self.away = "" if heard else "not_heard"
        self.gripper_mode = "ready" if heard else f"not listening at {self._output.topic[:100]}"
        if self._arm is not None and self._arm.accepting:
            guard = self._arm.guard
            self.gripper.poll(guard.writer, writer_active=guard.writer_active)

    def read(self, mono_ns: int) -> Measurement | None:
        """The newest joint states, with the robot's own stamp."""
        states = self.states
        fresh = states.update()
        self.measured_ns = states.received_ns
        self._check_clock()
        # Where this loop stood still for most of the silence, it says nothing about the robot.
        since_ns = 0 if self._read_ns is None else mono_ns - self._read_ns
        self._read_ns = mono_ns
        returned = since_ns < states.silent_ns / 2 and self._returned()
        if not fresh:
            return None
        stamp_ns = states.state.stamp_ns
        try:
            measured = states.state.measurement(states.wrench(stamp_ns), None)
        except RecordError as error:  # finite, but too large for a record
            topic = self._ros2.joint_states
            self._node.reject("invalid", f"{topic}: {error}", topic)
            return None
        made_ns = stamp_ns if self.sim_clock is None else self.sim_clock.newest_ns
        position_rad = self.kinematics.joints_of(measured.joints)
        self.posture = Posture(made_ns, position_rad)
        if returned:
            self._stay(measured, self._node.clock.wall_at(mono_ns))
        return measured._replace(gripper=self._gripper_state(stamp_ns))

    @property
    def turned_rad(self) -> FloatArray:
        return self.states.state.turned_rad

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Publish a set-point."""
        command = self.command_of(reference)
        stamp_ns = now_ns if self.sim_clock is None else self.sim_clock.newest_ns
        message = self._write(command, Stamp(stamp_ns, self._frame))
        self._writer.publish(self._messages.encode(message))
        self.setpoint = time.monotonic_ns(), reference
        self._node.counters["ros2.commands_sent"] += 1

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        self.gripper.move(command, now_ns)

    def _width_m(self) -> float | None:
        """Opening between the fingers, None if unknown."""
        return None if self._fingers_lost else self.states.state.width_m

    def _gripper_state(self, stamp_ns: int) -> GripperState | None:
        gripper, fingers = self.gripper, self.profile.robot.finger_joints
        state = self.states.state
        record = state.gripper(busy=gripper.busy, wanted_m=gripper.wanted_m, held=gripper.holding)
        if record is None:
            return None
        silent_ns = stamp_ns - state.width_stamp_ns
        lost = bool(fingers) and silent_ns > FINGERS_TIMEOUT_NS
        if lost and not self._fingers_lost:
            why = f"no joint state of {', '.join(fingers)}"
            self._node.emit(Event("warning", "fault", "fingers_lost", why))
        self._fingers_lost = lost
        return None if lost else record

    # -- status -------------------------------------------------------------------------------
    def _check_clock(self) -> None:
        """Emit an event when the robot's clock begins to differ from this one."""
        clock = self.states.clock
        if clock.differs == self._clock_reported or clock.offset_s is None:
            return
        self._clock_reported = clock.differs
        if clock.differs:
            stamp_ns = self.states.state.stamp_ns
            why = (
                f"the robot's stamps are {clock.offset_s:+.3f} s behind this clock; "
                f"{clock_remedy(stamp_ns, self.profile)}"
            )
            self._node.emit(Event("warning", "notice", "robot_clock", why))

    def _returned(self) -> bool:
        """Whether a robot is heard again that a set-point was sent to meanwhile: it is reported.

        A bridge keeps the last set-point until the lease of a subscriber that died ends, and sends
        it to a new one on Fast DDS that is reliable.
        """
        states = self.states
        sent_ns = None if self.setpoint is None else self.setpoint[0]
        silent_s = states.silent_ns / 1e9
        if silent_s <= self.profile.timing.state_timeout_s or self._ros2.bridge != "ros2dds":
            return False
        if sent_ns is None or sent_ns < states.silent_from_ns:
            return False  # it was alive and acknowledged it
        age_s = (time.monotonic_ns() - sent_ns) / 1e9
        why = (
            f"joint states again after {silent_s:.1f} s. A robot's node that was restarted may be "
            f"sent the set-point of {age_s:.1f} s ago by the bridge, before ours to stay where it "
            f"is: let it subscribe to {self._output.topic[:100]} best effort, which prevents this"
        )
        self._node.emit(Event("warning", "notice", "robot_returned", why))
        return True

    def _stay(self, measured: Measurement, now_ns: int) -> None:
        """Send a set-point where the arm is, unless it is being moved.

        It replaces the one that the bridge keeps, or ends the motion to it.
        """
        if self._arm is None or self._arm.guard.moving:
            return
        nothing = np.zeros(6)
        reference: PoseReference | JointReference = PoseReference(*measured.tcp, nothing, nothing)
        if self.profile.robot.command == "joint":
            reference = JointReference.at_rest(measured.joints.position_rad)
        self.move(reference, now_ns)

    def status(self) -> DriverStatus:
        """Its part of the node's status."""
        states, ages_s = self.states, {}
        detail = {
            "held": self._arm is not None and self._arm.holds,
            "robot_clock_behind_s": states.clock.offset_s,
            "sim_time_rate": None if self.sim_clock is None else self.sim_clock.rate,
            "width_m": states.state.width_m,
        }
        if self.measured_ns is not None:
            ages_s["joint_states"] = (time.monotonic_ns() - self.measured_ns) / 1e9
        return DriverStatus(detail, ages_s, {"joint_states": states.rate.rate_hz})


class StateSubscriber:
    """State of the arm and gripper from the robot's topics.

    `received_ns` is the monotonic time of the newest joint state, None before the first;
    `silent_ns` is the longest time between two of those that the last update took, and
    `silent_from_ns` when that began.
    """

    def __init__(
        self,
        node: Node,
        graph: RosGraph,
        messages: Messages,
        profile: Profile,
        kinematics: Kinematics,
        simulated: SimulatedClock | None,
    ) -> None:
        assert profile.ros2 is not None
        ros2 = self._ros2 = profile.ros2
        self._node, self._messages, self._base = node, messages, profile.robot.base_frame
        self.state = JointReading(profile, kinematics)
        self.clock = RobotClock()
        self.simulated = simulated
        self.rate = RateMeter()
        self.received_ns: int | None = None
        self.silent_from_ns = self.silent_ns = 0
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

    def _reject(self, topic: str, error: CodecError) -> None:
        self._node.reject(error.reason, f"{topic}: {error}", topic)

    def _decode(self, kind: str, arrival: ReceivedSample) -> Any:
        return read(self._messages, kind, arrival.sample.payload.to_bytes())

    def update(self) -> bool:
        """Process the messages that arrived; whether there is a new state of the arm's joints."""
        self._update_wrench()
        fresh, self.silent_ns = False, 0
        for buffer in self._joint_states:
            for arrival in buffer.drain():
                try:
                    joints = self._decode(JOINT_STATE, arrival)
                    arrived_ns = self._node.clock.wall_at(arrival.mono_ns)
                    if self._take(joints, arrived_ns) is None:
                        continue  # of the fingers alone, or of another robot
                except CodecError as error:
                    self._reject(str(arrival.sample.key_expr), error)
                    continue
                fresh = True
                if self.simulated is None:
                    self.clock.take(joints.stamp_ns, arrived_ns)
                else:
                    self.simulated.take(joints.stamp_ns, arrived_ns)
                since_ns = self.received_ns or arrival.mono_ns
                if arrival.mono_ns - since_ns > self.silent_ns:
                    self.silent_from_ns, self.silent_ns = since_ns, arrival.mono_ns - since_ns
                self.received_ns = arrival.mono_ns
                self.rate.tick()
        return fresh

    def _take(self, joints: Joints, arrived_ns: int) -> JointState | None:
        made_ns = joints.stamp_ns or arrived_ns
        if self.simulated is None:
            return self.state.take(joints, made_ns)
        if joints.velocity is not None:  # per simulated second
            joints = joints._replace(velocity=joints.velocity * self.simulated.rate)
        return self.state.take(joints, arrived_ns, made_ns)

    def _update_wrench(self) -> None:
        if self._wrenches is None or self._ros2.wrench is None:
            return
        frame = self._ros2.wrench.frame or self._base
        sign = -1.0 if self._ros2.wrench.exerted_by == "arm" else 1.0
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
                arrived_ns = self._node.clock.wall_at(arrival.mono_ns)
                stamp_ns = wall_stamp_ns(found.stamp_ns, arrived_ns, self.simulated)
                self._wrench = Wrench(stamp_ns, frame, sign * found.wrench)
