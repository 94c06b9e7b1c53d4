"""Driver of a ROS 2 robot: joint states in, set-points out; cameras, operators' topics.

Neither ROS nor DDS runs here: messages are CDR on keys of zenoh-bridge-ros2dds, or of a robot with
rmw_zenoh. Cameras and operators' topics have threads of their own.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, ReceivedSample
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.control.preflight import clock_remedy
from vla_zenoh.errors import CodecError, ProfileError, RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.nodes.camera.geometry import Pixels, resize
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S
from vla_zenoh.profile import Profile
from vla_zenoh.profile.robot import Ros2Camera, Ros2Output, Ros2Profile
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver, command_of
from vla_zenoh.robots.joint_reading import JointReading, RobotClock, SimulatedClock, StampFilter
from vla_zenoh.robots.ros2.gripper import Gripper
from vla_zenoh.robots.ros2.middleware import GRIPPER, Bridges, MiddlewareWatch, bridge_session
from vla_zenoh.robots.ros2.operator_topics import OperatorTopics
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.ros2.keys import COMMAND, SENSOR
from vla_zenoh.ros2.messages import MAX_PICTURE_BYTES, Messages
from vla_zenoh.ros2.readers import (
    JOINT_STATE,
    WRENCH,
    RosDepth,
    RosImage,
    Wrench,
    read,
    read_depth,
)
from vla_zenoh.ros2.writers import Stamp, Write, joint_writer, pose_writer
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.types import Event, FloatArray, GripperCommand, GripperState, JointState
from vla_zenoh.types.records import JointReference, Joints, PoseReference

NAME = "ros2"
JOIN_S = 0.3
MAX_DEFINITION_BYTES = 65_536
FINGERS_TIMEOUT_NS = 1_000_000_000
"""Gripper nodes publish more slowly than arms."""
BUFFER = 64
WRENCH_TIMEOUT_NS = 200_000_000
CAMERA_WAIT_S, CAMERA_SAME_S = 0.1, 2.0
"""A sensor has noise; a driver that repeats an image for less than the second is tolerated."""
DEPTHS_KEPT = 4
SAME_VIEW_PERIODS = 1.5
"""Depth may be this many image periods older than its colours: drivers publish it after them."""
LEAD_PERIODS = 2
"""A trajectory's point lies this many command periods ahead."""


class Ros2Driver(RobotDriver):
    """The ROS 2 robot of a profile; with another ``robot.driver``, only its cameras and topics.

    Raises:
        ProfileError: the section ros2 is missing or has an unknown name in it.
    """

    name = NAME

    def __init__(self, profile: Profile) -> None:
        super().__init__(profile)
        if profile.ros2 is None:
            raise ProfileError(
                f"profile {profile.name!r} has no section ros2; give --profile panda_ros2, or your "
                "own"
            )
        self._ros2 = profile.ros2
        self._messages = read_messages(profile.ros2)
        self.has_arm = profile.robot.driver == NAME
        if profile.ros2.gripper is None:
            self.no_gripper = "the profile has no ros2.gripper"
        self.silent_why = (
            f"nothing on {profile.ros2.joint_states}; is the robot or the bridge gone?"
        )
        self._halt = threading.Event()
        self._threads: list[threading.Thread] = []
        self._deferred: deque[Callable[[], None]] = deque(maxlen=256)
        self._others = 0
        self._bad_cameras: tuple[bool, ...] = ()
        self._clock_reported = self._fingers_lost = False
        self._moved_ns: int | None = None
        self._read_ns: int | None = None
        self._own_session: zenoh.Session | None = None

    def attach(self, node: Node, arm: Arm | None) -> None:
        """Join the ROS graph.

        Raises:
            ProfileError: a message type cannot carry the profile's commands.
            SessionError: ros2.connect does not answer.
            SecurityError: it is reached by TLS, and this node's certificate is missing.
        """
        super().attach(node, arm)
        profile, ros2 = self.profile, self._ros2
        self._node, self._arm, session = node, arm, node.session
        if ros2.connect is not None:
            settings = bridge_session(profile)
            self._own_session = open_session(settings, identity=NAME, wait_s=ROUTER_PATIENCE_S)
        name = "".join(each if each.isalnum() else "_" for each in profile.robot.name)
        graph = self.graph = RosGraph(
            self._own_session or session, ros2, self._messages, f"vla_{name}"
        )
        simulated = self._simulated = SimulatedClock() if ros2.use_sim_time else None
        bridges = Bridges(graph.session, profile, self._silent)
        watch = self._middleware = MiddlewareWatch(bridges, self._emit)
        if self.has_arm:
            self.gripper = Gripper(
                node,
                graph,
                self._messages,
                ros2.gripper,
                self._width_m,
                lambda: watch.faults.get(GRIPPER, ""),
                dict(zip(profile.robot.finger_joints, self.kinematics.finger_signs, strict=True)),
            )
            self.states = StateSubscriber(
                node, graph, self._messages, ros2, self.kinematics, simulated
            )
            command = profile.robot.command
            output = ros2.joint_command if command == "joint" else ros2.pose_command
            if output is None:
                raise ProfileError(f"ros2 lacks {command}_command")
            self._output, self._frame = output, output.frame or profile.robot.base_frame
            self._write = self.writing(output)
            self._writer = graph.publisher(output.topic, output.type, COMMAND)
        self._cameras = [
            Camera(
                camera,
                topic,
                node,
                graph,
                read_messages(ros2),
                self._emit,
                self._reject,
                simulated,
            )
            for camera, topic in profile.ros2_cameras().items()
        ]
        self._operators = None
        if ros2.prefix is not None:
            self._operators = OperatorTopics(
                profile,
                session,
                graph,
                bridges,
                read_messages(ros2),
                ros2.prefix,
                self._reject,
                services=ros2.services,
                about=watch.about,
            )
        for buffer in graph.buffers:
            node.watch_buffer(buffer)

    def writing(self, output: Ros2Output) -> Write:
        """Function that fills a message of the output's type, or a `ProfileError`."""
        if self.profile.robot.command == "joint":
            lead_ns = round(LEAD_PERIODS * self.period_s * 1e9)
            return joint_writer(self._messages, output.type, lead_ns)
        return pose_writer(self._messages, output.type, np.array(self.profile.robot.home_rad))

    # -- for the threads ----------------------------------------------------------------------
    def _silent(self) -> list[str]:
        """Topics of the robot on which nothing comes."""
        topics = [camera.topic for camera in self._cameras if camera.silent]
        if self.has_arm:
            last_ns = self.states.received_ns
            if last_ns is None or time.monotonic_ns() - last_ns > STALL_S * 1e9:
                topics.append(self._ros2.joint_states)
        return topics

    def _emit(self, event: Event) -> None:
        self._deferred.append(lambda: self._node.emit(event))

    def _reject(self, reason: str, why: str, about: str) -> None:
        self._deferred.append(lambda: self._node.reject(reason, why, about))

    def connect(self) -> None:
        """Start the threads of cameras, operators' topics and what watches the middleware."""
        threaded = (*self._cameras, self._operators, self._middleware)
        bodies = [each.run for each in threaded if each is not None]
        self._threads = [
            threading.Thread(target=body, args=(self._halt,), name=f"ros2 {index}", daemon=True)
            for index, body in enumerate(bodies)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the threads and leave the ROS graph."""
        self._halt.set()
        deadline_s = time.monotonic() + JOIN_S
        for thread in self._threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        self.graph.close()
        if self._own_session is not None:
            self._own_session.close()

    # -- the arm ------------------------------------------------------------------------------
    def poll(self, mono_ns: int) -> None:
        """Handle answers of the gripper, and events of the threads."""
        if self._arm is not None:
            # With no subscriber a set-point is dropped: then no controller holds it.
            heard = self._writer.has_subscribers
            self.away = "" if heard else "not_heard"
            self.gripper_mode = "ready" if heard else f"not listening at {self._output.topic[:100]}"
            if self._arm.accepting:
                guard = self._arm.guard
                self.gripper.poll(guard.writer, writer_active=guard.writer_active)
        while self._deferred:
            self._deferred.popleft()()
        self._check_peers()

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
        if returned:
            self._stay(measured, self._node.clock.wall_at(mono_ns))
        return measured._replace(gripper=self._gripper_state(stamp_ns))

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Publish a set-point."""
        command = command_of(reference, self.profile.robot.arm_joints)
        stamp_ns = now_ns if self._simulated is None else self._simulated.newest_ns
        message = self._write(command, Stamp(stamp_ns, self._frame))
        self._writer.publish(self._messages.encode(message))
        self._moved_ns = time.monotonic_ns()
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
        states, sent_ns = self.states, self._moved_ns
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

    def _check_peers(self) -> None:
        """Emit an event when the other side appears or disappears."""
        others, before = self.graph.others, self._others
        self._others = others
        if bool(others) == bool(before):
            return
        what = "bridge" if self._ros2.bridge == "ros2dds" else "ROS 2 node"
        event = Event("info", "transition", "bridge:gone->there", f"a {what} is there")
        if not others:
            why = f"no {what} is there any more"
            event = Event("warning", "transition", "bridge:there->gone", why)
        self._node.emit(event)

    def status_changed(self) -> bool:
        """Whether a camera went bad or recovered."""
        bad = tuple(camera.publisher.fault is not None for camera in self._cameras)
        changed, self._bad_cameras = bad != self._bad_cameras, bad
        return changed

    def status(self) -> DriverStatus:
        """Arm, cameras and ROS graph."""
        node, publishers = self._node, [camera.publisher for camera in self._cameras]
        figures = {publisher.name: publisher.figures() for publisher in publishers}
        for publisher in publishers:
            for name, count in publisher.counters().items():
                node.counters[name] = count
        detail = {
            "cameras": {publisher.name: publisher.detail() for publisher in publishers},
            "bridge": self._ros2.bridge,
            "others": self.graph.others,
            "middleware": self._middleware.view.middleware,
            "ros2_faults": dict(self._middleware.faults),
        }
        ages_s, rates_hz = {}, {name: rate_hz for name, (rate_hz, _) in figures.items()}
        if self._arm is not None:
            states = self.states
            node.counters["ros2.unstamped"] = states.clock.unstamped
            node.counters["ros2.efforts_missing"] = states.state.efforts_missing
            detail |= {
                "held": self._arm.holds,
                "robot_clock_behind_s": states.clock.offset_s,
                "sim_time_rate": None if self._simulated is None else self._simulated.rate,
                "width_m": states.state.width_m,
            }
            rates_hz["joint_states"] = states.rate.rate_hz
            if self.measured_ns is not None:
                ages_s["joint_states"] = (time.monotonic_ns() - self.measured_ns) / 1e9
        latency_ms = {name: late for name, (_, late) in figures.items() if late is not None}
        return DriverStatus(detail, ages_s, rates_hz, latency_ms)


class Camera:
    """One camera topic: `run` is the body of its thread, the only user of `messages`.

    It uses publishers and clock of the `node`; `emit` and `reject` may be called from any thread.
    """

    def __init__(
        self,
        name: str,
        topic: Ros2Camera,
        node: Node,
        graph: RosGraph,
        messages: Messages,
        emit: Callable[[Event], None],
        reject: Callable[[str, str, str], None],
        simulated: SimulatedClock | None,
    ) -> None:
        self.topic = topic.topic
        self.silent = False
        self._topic, self._node, self._messages, self._reject = topic, node, messages, reject
        self._simulated = simulated
        self.publisher = CameraPublisher(
            name, node.profile.cameras[name], topic.topic, node, emit, CAMERA_SAME_S
        )
        self.publisher.backend = topic.type
        self._stamps = StampFilter()
        self._decoded_s = -LOOK_S
        self._image = graph.subscribe(
            topic.topic, topic.type, LatestSample(MAX_PICTURE_BYTES), SENSOR
        )
        self._depth = None
        if topic.depth is not None:
            ring = CallbackRing(DEPTHS_KEPT, MAX_PICTURE_BYTES)
            self._depth = graph.subscribe(topic.depth.topic, topic.depth.type, ring, SENSOR)
        self._depths: deque[RosDepth] = deque(maxlen=DEPTHS_KEPT)

    def run(self, stop: threading.Event) -> None:
        """Publish images until `stop` is set."""
        last_s = time.monotonic()
        while not stop.is_set():
            if self._image.wait(CAMERA_WAIT_S):
                arrival = self._image.pop()
                if arrival is not None and self._handle(arrival):
                    last_s = time.monotonic()
            silent_s = time.monotonic() - last_s
            self.silent = silent_s > STALL_S
            if self.silent:
                self.publisher.lose(f"no image on {self.topic} for {silent_s:.0f} s")

    def _handle(self, arrival: ReceivedSample) -> bool:
        """Publish an image, or check it now and then; whether it is a valid one."""
        publisher, now_s = self.publisher, time.monotonic()
        wanted = publisher.due(arrival.mono_ns) and publisher.has_subscribers
        if not wanted and now_s - self._decoded_s < LOOK_S:
            if publisher.state == OK:
                publisher.captured(arrival.mono_ns)
            return publisher.state == OK
        self._decoded_s = now_s
        payload, frame = arrival.sample.payload.to_bytes(), self._topic.frame
        try:
            image: RosImage = read(self._messages, self._topic.type, payload)
            if frame is not None and image.frame != frame:
                raise CodecError("frame", f"in frame {image.frame[:60]!r}, wanted {frame!r}")
            publisher.check(image.rgb, arrival.mono_ns, image.stamp_ns or None)
            if image.stamp_ns:
                self._stamps.check(image.stamp_ns)
        except CodecError as error:
            self._reject(error.reason, f"{self.topic}: {error}", publisher.name)
            if error.reason in ("encoding", "frame"):  # true for all further images
                publisher.lose(str(error))
            return False
        publisher.captured(arrival.mono_ns)
        publisher.set_state(OK)
        if wanted:
            settings = publisher.profile
            rgb = resize(image.rgb, settings.width, settings.height)
            arrived_ns = self._node.clock.wall_at(arrival.mono_ns)
            stamp_ns = wall_stamp_ns(image.stamp_ns, arrived_ns, self._simulated)
            publisher.publish_rgb(rgb, arrival.mono_ns, stamp_ns, self._depth_at(image.stamp_ns))
        return True

    def _depth_at(self, stamp_ns: int) -> Pixels | None:
        """(H, W) metres that were measured when the image was taken; None if there are none."""
        topic, settings = self._topic.depth, self.publisher.profile
        if self._depth is None or topic is None:
            return None
        for arrival in self._depth.drain():
            if not self.publisher.wants_depth:
                continue
            try:
                payload = arrival.sample.payload.to_bytes()
                self._depths.append(read_depth(self._messages, topic.type, payload))
            except CodecError as error:
                self._reject(error.reason, f"{topic.topic}: {error}", self.publisher.name)
        if not self._depths:
            return None
        near = min(self._depths, key=lambda depth: abs(depth.stamp_ns - stamp_ns))
        if abs(near.stamp_ns - stamp_ns) * settings.rate_hz > SAME_VIEW_PERIODS * 1e9:
            return None
        return resize(near.depth_m, settings.width, settings.height, depth=True)


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
        ros2: Ros2Profile,
        kinematics: Kinematics,
        simulated: SimulatedClock | None,
    ) -> None:
        self._node, self._messages, self._ros2 = node, messages, ros2
        self.state = JointReading(node.profile, kinematics)
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
                arrived_ns = self._node.clock.wall_at(arrival.mono_ns)
                stamp_ns = wall_stamp_ns(found.stamp_ns, arrived_ns, self.simulated)
                self._wrench = found._replace(stamp_ns=stamp_ns)


def wall_stamp_ns(stamp_ns: int, arrived_ns: int, simulated: SimulatedClock | None) -> int:
    """When a message was made, in our time; a stamp of 0 is none."""
    if simulated is not None:
        return simulated.wall_ns(stamp_ns, arrived_ns)
    return stamp_ns or arrived_ns


def read_messages(ros2: Ros2Profile) -> Messages:
    """Messages of the distribution and the definition files, or a `ProfileError` about one."""
    texts: dict[str, str] = {}
    for kind, path in ros2.messages.items():
        try:
            with Path(path).expanduser().open("rb") as file:
                texts[kind] = file.read(MAX_DEFINITION_BYTES).decode("utf-8")
        except (OSError, ValueError, RuntimeError) as error:
            raise ProfileError(f"ros2.messages.{kind}: {path} cannot be read: {error}") from error
    return Messages(ros2.distribution, texts)
