"""The node ``ros2`` between a robot that speaks a bridge's wire form and somebody who watches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh
from camera_rig import PATIENCE_S, free_endpoint, until
from ros2_peer import KinematicPanda, Ros2Peer
from vla_zenoh_ros2.driver import Ros2Driver

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.keys import Kind
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.robots.node import RobotNode
from vla_zenoh.types import Event, GripperState, Header, JointState, NodeStatus, PoseState

CAMERA = "/camera/realsense2_camera/color/image_raw"
WIDTH, HEIGHT = 64, 48
COMMAND_HZ = 100
"""Of a node that runs in real time."""
STATUS_PERIOD_S = 0.1
"""Nearly every test waits for a status."""
PROFILE = """\
extends: panda_ros2
cameras:
  front: {{source: "ros2:{camera}", width: {width}, height: {height}, rate_hz: 60{depth_unit}}}
  wrist: null
timing: {{command_timeout_s: 0.3, state_timeout_s: 0.5, command_hz: {command_hz}}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
ros2:
  bridge: {bridge}
  cameras: {{wrist: null{depth}}}
{more}"""
DEPTH = "/camera/aligned_depth_to_color/image_raw"


def write_profile(
    folder: Path,
    bridge: str = "ros2dds",
    more: str = "",
    *,
    depth: bool = False,
    command_hz: int = 250,
) -> Path:
    """A profile of a ROS 2 Panda with one small camera, on an address of its own.

    `more` is YAML that goes on in the section ros2; with `depth` the camera has it, too.
    """
    path = folder / "ros2.yaml"
    path.write_text(
        PROFILE.format(
            bridge=bridge,
            endpoint=free_endpoint(),
            command_hz=command_hz,
            camera=CAMERA,
            width=WIDTH,
            height=HEIGHT,
            more=more,
            depth_unit=", depth_unit_m: 0.001" if depth else "",
            depth=f", front: {{topic: {CAMERA}, depth: {{topic: {DEPTH}}}}}" if depth else "",
        )
    )
    return path


@dataclass
class Ros2Rig:
    """What a test holds."""

    profile: Profile
    node: RobotNode
    session: zenoh.Session
    ours: zenoh.Session
    peer: Ros2Peer
    robot: KinematicPanda
    states: dict[type, list[tuple[Header, Any]]] = field(default_factory=dict)
    statuses: list[NodeStatus] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def newest(self, kind: type) -> Any:
        return until(f"a {kind.__name__}", lambda: self.states[kind][-1:])[0][1]

    def wait(self, what: str, ask: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
        try:
            return until(what, ask, timeout_s)
        except AssertionError as error:
            story = [f"{event.what}: {event.why}" for event in self.events[-12:]]
            status = self.statuses[-1] if self.statuses else None
            raise AssertionError(f"{error}\nevents: {story}\nstatus: {status}") from None

    def counted(self, name: str) -> int:
        return self.statuses[-1].counters.get(name, 0) if self.statuses else 0

    def detail(self, name: str) -> Any:
        return self.statuses[-1].detail.get(name) if self.statuses else None

    def happened(self, what: str) -> list[Event]:
        return [event for event in self.events if event.what == what]

    def wait_for_service(self, name: str, kind: str) -> None:
        """Wait until the node's session sees a service of the peer."""
        querier = self.ours.declare_querier(self.peer.key(name, kind))
        self.wait(f"the node sees {name}", lambda: querier.matching_status.matching)
        querier.undeclare()

    def stream(self, key: str, source: str = "command#1") -> Publisher:
        """A writer of commands; waits until the node hears it."""
        kind = Kind.ORDER if key == self.profile.keys.command_gripper else Kind.CONTROL
        stream = Publisher(self.session, key, kind, source, Clock())
        until(f"the node listens to {key}", lambda: stream.has_subscribers)
        return stream


@contextmanager
def ros2_rig(
    folder: Path,
    bridge: str = "ros2dds",
    more: str = "",
    *,
    depth: bool = False,
    clock_ns: int = 0,
) -> Iterator[Ros2Rig]:
    """The node, in a thread, and a kinematic Panda on the other side."""
    path = write_profile(folder, bridge, more, depth=depth, command_hz=COMMAND_HZ)
    profile = load_profile(str(path))
    with (
        pytest.MonkeyPatch.context() as patched,
        open_session(profile.session, mode="router"),
        open_session(profile.session) as theirs,
        open_session(profile.session) as ours,
        open_session(profile.session) as watcher,
    ):
        patched.setattr("vla_zenoh.bus.node.STATUS_PERIOD_S", STATUS_PERIOD_S)
        patched.setattr("vla_zenoh.robots.node.REPLIES", 0)  # nobody else has its name
        patched.setattr("vla_zenoh.robots.node.gc", Mock())  # this process has more than a node
        peer = Ros2Peer(theirs, bridge)
        node = RobotNode(Ros2Driver(profile), ours)
        robot = KinematicPanda(peer, clock_ns=clock_ns)
        rig = Ros2Rig(profile, node, watcher, ours, peer, robot)
        keys = profile.keys
        subscribers = [
            _keep(watcher, key, kind, rig.states.setdefault(kind, []))
            for key, kind in (
                (keys.state_joint, JointState),
                (keys.state_pose, PoseState),
                (keys.state_gripper, GripperState),
            )
        ]
        subscribers.append(_listen(watcher, keys.status("ros2"), NodeStatus, rig.statuses.append))
        subscribers.append(_listen(watcher, keys.event("ros2"), Event, rig.events.append))
        stop = threading.Event()
        thread = threading.Thread(target=node.run, args=(stop,))
        thread.start()
        try:
            yield rig
        finally:
            stop.set()
            thread.join(5.0)
            robot.close()
            peer.close()
            for subscriber in subscribers:
                subscriber.undeclare()
            assert not thread.is_alive(), "the node does not end"


def _keep(
    session: zenoh.Session, key: str, kind: type, heard: list[tuple[Header, Any]]
) -> zenoh.Subscriber[Any]:
    def keep(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        header = records.decode_header(sample.attachment.to_bytes())
        heard.append((header, records.decode(kind, sample.payload.to_bytes())))

    return session.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))


def _listen(
    session: zenoh.Session, key: str, kind: type, take: Callable[[Any], None]
) -> zenoh.Subscriber[Any]:
    def keep(sample: zenoh.Sample) -> None:
        take(records.decode(kind, sample.payload.to_bytes()))

    return session.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))
