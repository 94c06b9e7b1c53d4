"""Driver of a ROS 2 robot: its arms, each with topics of its own; cameras, operators' topics.

Neither ROS nor DDS runs here: messages are CDR on keys of zenoh-bridge-ros2dds, or of a robot with
rmw_zenoh. Cameras and operators' topics have threads of their own.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import zenoh

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile
from vla_zenoh.profile.robot import Ros2Profile
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver
from vla_zenoh.robots.joint_reading import SimulatedClock
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S, realtime_links
from vla_zenoh.types import Event
from vla_zenoh.types.records import JointReference, PoseReference
from vla_zenoh_ros2.arm import NAME, Ros2Arm
from vla_zenoh_ros2.camera import Camera
from vla_zenoh_ros2.frames import FrameTopics
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.middleware import Bridges, MiddlewareWatch, bridge_session, gripper_fault
from vla_zenoh_ros2.operator_topics import OperatorTopics
from vla_zenoh_ros2.ros_graph import RosGraph

JOIN_S = 0.3
MAX_DEFINITION_BYTES = 65_536


class Ros2Driver(RobotDriver):
    """The ROS 2 robot of a profile; with another ``robot.driver``, only its cameras and topics.

    Raises:
        ProfileError: the section ros2 is missing, has an unknown name in it, or a message type that
            cannot carry the profile's commands.
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
        messages = self._messages = read_messages(profile.ros2)
        self.has_arm = profile.robot.driver == NAME
        names = profile.part_names if self.has_arm else ()
        self._arms = {name: Ros2Arm(profile.of_part(name), messages) for name in names}
        self._halt = threading.Event()
        self._threads: list[threading.Thread] = []
        self._deferred: deque[Callable[[], None]] = deque(maxlen=256)
        self._others = 0
        self._bad_cameras: tuple[bool, ...] = ()
        self._own_session: zenoh.Session | None = None

    @property
    def parts(self) -> Mapping[str, Ros2Arm]:
        return self._arms

    def read(self, mono_ns: int) -> Measurement | None:
        return next(iter(self._arms.values())).read(mono_ns)

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        next(iter(self._arms.values())).move(reference, now_ns)

    def attach(self, node: Node, arm: Arm | None) -> None:
        """Join the ROS graph.

        Raises:
            SessionError: ros2.connect does not answer.
            SecurityError: it is reached by TLS, and this node's certificate is missing.
        """
        super().attach(node, arm)
        profile, ros2 = self.profile, self._ros2
        self._node, session = node, node.session
        if ros2.connect is not None:
            settings = bridge_session(profile)
            self._own_session = open_session(settings, identity=NAME, wait_s=ROUTER_PATIENCE_S)
        name = "".join(each if each.isalnum() else "_" for each in profile.robot.name)
        graph = self.graph = RosGraph(
            self._own_session or session, ros2, self._messages, f"vla_{name}"
        )
        bridges = Bridges(graph.session, profile, self._silent)
        watch = self._middleware = MiddlewareWatch(bridges, self._emit)
        for part, one in self._arms.items():
            fault = gripper_fault(part)
            one.join(node, graph, lambda fault=fault: watch.faults.get(fault, ""))
        simulated = SimulatedClock() if ros2.use_sim_time else None
        if self._arms:
            simulated = next(iter(self._arms.values())).sim_clock
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
        self._frames = None
        if ros2.tf:
            self._frames = FrameTopics(
                profile,
                graph,
                self._arms,
                self._cameras,
                read_messages(ros2),
                self._emit,
                self._reject,
            )
        for buffer in graph.buffers:
            node.watch_buffer(buffer)

    # -- for the threads ----------------------------------------------------------------------
    def _silent(self) -> list[str]:
        """Topics of the robot on which nothing comes."""
        topics = [camera.topic for camera in self._cameras if camera.silent]
        for arm in self._arms.values():
            topics += arm.silent_topics
        return list(dict.fromkeys(topics))

    def _emit(self, event: Event) -> None:
        self._deferred.append(lambda: self._node.emit(event))

    def _reject(self, reason: str, why: str, about: str) -> None:
        self._deferred.append(lambda: self._node.reject(reason, why, about))

    def connect(self) -> None:
        """Start the threads of cameras, operators' topics and what watches the middleware."""
        watchers = (self._operators, self._middleware, self._frames)
        with realtime_links():  # they share the GIL with the arm's loop
            self._threads = [self._start(each.run) for each in watchers if each is not None]
        self._threads += [self._start(camera.run) for camera in self._cameras]

    def _start(self, body: Callable[[threading.Event], None]) -> threading.Thread:
        thread = threading.Thread(target=body, args=(self._halt,), name="ros2", daemon=True)
        thread.start()
        return thread

    def close(self) -> None:
        """Stop the threads and leave the ROS graph."""
        self._halt.set()
        deadline_s = time.monotonic() + JOIN_S
        for thread in self._threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        self.graph.close()
        if self._own_session is not None:
            self._own_session.close()

    # -- one tick -----------------------------------------------------------------------------
    def poll(self, mono_ns: int) -> None:
        """Handle answers of the grippers, and events of the threads."""
        for arm in self._arms.values():
            arm.poll(mono_ns)
        while self._deferred:
            self._deferred.popleft()()
        self._check_peers()

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
        """Arms, cameras and ROS graph."""
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
        if self._frames is not None:
            detail |= self._frames.detail
        ages_s, rates_hz = {}, {name: rate_hz for name, (rate_hz, _) in figures.items()}
        arms = self._arms.values()
        if arms:
            node.counters["ros2.unstamped"] = sum(arm.states.clock.unstamped for arm in arms)
            missing = sum(arm.states.state.efforts_missing for arm in arms)
            node.counters["ros2.efforts_missing"] = missing
        for name, arm in self._arms.items():
            found, of = arm.status(), f"{name}/" if name else ""
            detail |= {f"{of}{key}": value for key, value in found.detail.items()}
            ages_s |= {f"{of}{key}": age_s for key, age_s in found.ages_s.items()}
            rates_hz |= {f"{of}{key}": rate_hz for key, rate_hz in found.rates_hz.items()}
        latency_ms = {name: late for name, (_, late) in figures.items() if late is not None}
        return DriverStatus(detail, ages_s, rates_hz, latency_ms)


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
