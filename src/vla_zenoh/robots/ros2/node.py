"""A ROS 2 robot on the bus: takes command keys, gives state and camera keys.

No ROS and no DDS here: messages are CDR on keys of zenoh-bridge-ros2dds, or of a robot that runs
rmw_zenoh. The main loop runs at the rate of the command stream; cameras and services have threads.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import zenoh

from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import ProfileError
from vla_zenoh.interop.python_reading import MAX_WORDS
from vla_zenoh.interop.ros2.graph import camera_topics
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.profile import Profile, SessionProfile
from vla_zenoh.profile.ros2 import Ros2Profile
from vla_zenoh.profile.session import TRUSTED_PROTOCOLS
from vla_zenoh.robots.ros2.arm import Arm
from vla_zenoh.robots.ros2.cameras import Camera
from vla_zenoh.robots.ros2.gripper import Gripper
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.robots.ros2.ros_services import RosServices
from vla_zenoh.robots.shutdown_brake import ShutdownBrake
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.scheduling import realtime_thread
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event

NAME = "ros2"
SWITCH_INTERVAL_S = 5e-4
GOODBYE_S = 0.3
CLOCK_PERIOD_S = 0.1
MAX_DEFINITION_BYTES = 65_536


def read_messages(ros2: Ros2Profile) -> Messages:
    """The messages of the profile's distribution, and those of its files.

    Raises:
        ProfileError: a file that is not there or no definition.
    """
    texts: dict[str, str] = {}
    for kind, path in ros2.messages.items():
        try:
            with Path(path).expanduser().open("rb") as file:
                texts[kind] = file.read(MAX_DEFINITION_BYTES).decode("utf-8")
        except (OSError, ValueError, RuntimeError) as error:
            raise ProfileError(f"ros2.messages.{kind}: {path} cannot be read: {error}") from error
    return Messages(ros2.distribution, texts)


class Ros2Node:
    """See the module.

    Args:
        profile: the effective profile, with its section ros2.
        session: open session to our own router, closed by whoever opened it.

    Raises:
        ProfileError: the section ros2 is missing or names what is not known.
        NodeError: a node of this name is alive already.
        SessionError: ros2.connect does not answer.
        SecurityError: it is reached by TLS, and this node's certificate is not there.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        if profile.ros2 is None:
            raise ProfileError(
                f"profile {profile.name!r} has no section ros2; give --profile panda_ros2, or your "
                "own"
            )
        ros2 = profile.ros2
        messages = read_messages(ros2)
        node = self.node = Node(NAME, profile, session)
        self._own_session = None
        if ros2.connect is not None:
            way = _way(profile, ros2.connect)
            self._own_session = open_session(way, identity=NAME, wait_s=ROUTER_PATIENCE_S)
        self.link = RosGraph(
            self._own_session or session, ros2, messages, f"vla_{_ros_name(profile.robot.name)}"
        )
        self._halt = threading.Event()
        self._news: deque[Callable[[], None]] = deque(maxlen=256)
        self._bridges = 0
        self._gripper: Gripper | None = None
        self._arm: Arm | None = None
        self._last_brake: ShutdownBrake | None = None
        if profile.robot.driver == NAME:
            gripper = self._gripper = Gripper(
                node, self.link, messages, ros2.gripper, self._width_m
            )
            self._arm = Arm(
                node,
                self.link,
                messages,
                ros2,
                lambda: (gripper.busy, gripper.wanted_m, gripper.holding),
            )
            self._last_brake = ShutdownBrake(node, self._arm.lead)
        self._cameras = [
            Camera(name, topic, node, self.link, read_messages(ros2), self._tell, self._refuse)
            for name, topic in camera_topics(profile).items()
        ]
        self._people = None
        if ros2.services is not None:
            self._people = RosServices(
                profile, session, self.link, read_messages(ros2), ros2.services, self._refuse
            )
        for slot in self.link.slots:
            node.watch_buffer(slot)
        self._rate = RateMeter()
        self._bad: tuple[bool, ...] = ()
        self._realtime = False
        self._clock_s = 0.0

    def _width_m(self) -> float | None:
        return None if self._arm is None else self._arm.width_m

    # -- for the threads ----------------------------------------------------------------------
    def _tell(self, event: Event) -> None:
        self._news.append(lambda: self.node.emit(event))

    def _refuse(self, reason: str, why: str, about: str) -> None:
        self._news.append(lambda: self.node.reject(reason, why, about))

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Drive until `stop` is set; a motion is braked first."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        bodies = [camera.run for camera in self._cameras]
        if self._people is not None:
            bodies.append(self._people.run)
        threads = [
            threading.Thread(target=body, args=(self._halt,), name=f"ros2 {index}", daemon=True)
            for index, body in enumerate(bodies)
        ]
        for thread in threads:
            thread.start()
        gc.collect()
        gc.freeze()
        try:
            with realtime_thread() as self._realtime:
                self._loop(FixedRate(self.node.profile.timing.command_hz), stop)
        finally:
            self._halt.set()
            give_up = time.monotonic() + GOODBYE_S
            for thread in threads:
                thread.join(max(0.0, give_up - time.monotonic()))
            self.node.publish_status("stopped", now=True)
            self.node.close()
            self.link.close()
            if self._own_session is not None:
                self._own_session.close()

    def _loop(self, pace: FixedRate, stop: threading.Event) -> None:
        """Drive; whatever goes wrong in it, the arm is braked before this ends."""
        try:
            self._drive(pace, stop)
        except Exception as error:
            how = "ends"
            if self._last_brake is not None:
                braked = self._last_brake.wind_down(pace, self._brake_on)
                how = "braked, and ends" if braked else "not braked, and ends"
            why = f"{one_line(repr(error), MAX_WORDS)}: {how}"
            self.node.emit(Event("error", "fault", "broken", why))
            raise

    def _brake_on(self, tick: Tick) -> None:
        assert self._arm is not None
        now_ns = self.node.clock.wall_at(tick.nominal_ns)
        self._arm.wind_down(now_ns, tick.nominal_ns, tick.stall_s)

    def _drive(self, pace: FixedRate, stop: threading.Event) -> None:
        while True:
            tick = pace.wait()
            if tick.periods > 1:
                self.node.counters["ros2.missed_ticks"] += tick.periods - 1
            now_ns = self.node.clock.wall_at(tick.nominal_ns)
            if self._arm is not None:
                self._arm.turn(now_ns, tick.nominal_ns, tick.stall_s)
            last = self._last_brake
            if stop.is_set() and (last is None or last.over(tick.nominal_ns)):
                return
            if self._gripper is not None and self._arm is not None and not stop.is_set():
                lead = self._arm.lead
                self._gripper.turn(now_ns, lead.writer, leads=lead.leads)
            while self._news:
                self._news.popleft()()
            self._rate.tick()
            self._watch()

    # -- status -------------------------------------------------------------------------------
    def _watch(self) -> None:
        if time.monotonic() - self._clock_s >= CLOCK_PERIOD_S:
            self._clock_s = time.monotonic()
            self.node.adopt_system_time()
            self._watch_bridges()
        state = "running" if self._arm is None else self._arm.state
        bad = tuple(camera.outlet.fault is not None for camera in self._cameras)
        if bad == self._bad and not self.node.status_due(state):
            return
        now, self._bad = bad != self._bad, bad
        figures = {camera.outlet.name: camera.outlet.figures() for camera in self._cameras}
        for camera in self._cameras:
            for what, count in camera.outlet.counters().items():
                self.node.counters[what] = count
        age_s = None if self._arm is None else self._arm.heard.age_s
        rates_hz = {"loop": self._rate.rate_hz}
        if self._arm is not None:
            rates_hz["joint_states"] = self._arm.heard.rate.rate_hz
        self.node.publish_status(
            state,
            detail={
                **({} if self._arm is None else self._arm.detail()),
                "cameras": {camera.outlet.name: camera.outlet.detail() for camera in self._cameras},
                "bridge": self._ros2.bridge,
                "others": self.link.others,
                "realtime": self._realtime,
            },
            ages_s={} if age_s is None else {"joint_states": age_s},
            rates_hz=rates_hz | {name: rate_hz for name, (rate_hz, _) in figures.items()},
            latency_ms={name: late for name, (_, late) in figures.items() if late is not None},
            now=now,
        )

    @property
    def _ros2(self) -> Ros2Profile:
        assert self.node.profile.ros2 is not None
        return self.node.profile.ros2

    def _watch_bridges(self) -> None:
        """Tell when the other side is there, or gone."""
        others, before = self.link.others, self._bridges
        self._bridges = others
        if bool(others) == bool(before):
            return
        what = "bridge" if self._ros2.bridge == "ros2dds" else "ROS 2 node"
        event = (
            Event("info", "transition", "bridge:gone->there", f"a {what} is there")
            if others
            else Event(
                "warning", "transition", "bridge:there->gone", f"no {what} is there any more"
            )
        )
        self.node.emit(event)


def _way(profile: Profile, places: tuple[str, ...]) -> SessionProfile:
    """The session to a bridge or router of the robot's own."""
    lease_ms = profile.session.lease_ms
    if all(endpoint.partition("/")[0] in TRUSTED_PROTOCOLS for endpoint in places):
        security = profile.session.security
        return SessionProfile(connect=places, listen=places, lease_ms=lease_ms, security=security)
    return SessionProfile(connect=places, lease_ms=lease_ms)


def _ros_name(name: str) -> str:
    """A robot's name as ROS takes it: letters, digits and underscores."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)
