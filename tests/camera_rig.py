"""A router, a camera node and somebody who watches: three real sessions in one process."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import image as image_codec
from vla_zenoh.codec import records
from vla_zenoh.nodes.camera.node import CameraNode
from vla_zenoh.profile import Profile, SessionProfile, load_profile
from vla_zenoh.profile.schema import CameraProfile, HostProfile
from vla_zenoh.types import Event, Header, NodeStatus

PATIENCE_S = 10.0
Value = TypeVar("Value")


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def routed_session() -> Iterator[zenoh.Session]:
    """A client's session with a router of its own."""
    endpoint = free_endpoint()
    profile = SessionProfile(listen=(endpoint,), connect=(endpoint,))
    with open_session(profile, mode="router"), open_session(profile) as session:
        yield session


def until(what: str, ask: Callable[[], Value | None], timeout_s: float = PATIENCE_S) -> Value:
    """The first true answer; fails, naming `what`, when none comes."""
    give_up = time.monotonic() + timeout_s
    while time.monotonic() < give_up:
        answer = ask()
        if answer:
            return answer
        time.sleep(0.01)
    raise AssertionError(f"waited {timeout_s:g} s in vain: {what}")


def await_match(session: zenoh.Session, key: str) -> None:
    """Until what `session` writes on `key` is heard by somebody."""
    publisher = session.declare_publisher(key)
    until(f"somebody listening to {key}", lambda: publisher.matching_status.matching)
    publisher.undeclare()


@dataclass
class Frame:
    """A sample of a camera key, as it arrived."""

    header: Header
    payload: bytes
    encoding: str
    arrived_ns: int

    @property
    def rgb(self) -> np.ndarray:
        kind, _, schema = self.encoding.partition(";")
        if kind == "image/jpeg":
            return image_codec.decode_jpeg(self.payload).rgb
        assert kind == "zenoh/bytes"
        return image_codec.decode_raw(self.payload, schema).rgb


@dataclass
class Rig:
    """What a test holds: the profile, the node, and everything that was heard."""

    profile: Profile
    watcher: zenoh.Session
    session: zenoh.Session
    node: CameraNode
    thread: threading.Thread
    stop: threading.Event
    statuses: list[NodeStatus] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def listen(self, key: str) -> tuple[list[Frame], Any]:
        """Frames on `key` from now on, and their subscriber."""
        frames: list[Frame] = []

        def keep(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            assert attachment is not None
            frames.append(
                Frame(
                    records.decode_header(attachment.to_bytes()),
                    sample.payload.to_bytes(),
                    str(sample.encoding),
                    time.time_ns(),
                )
            )

        handler = zenoh.handlers.Callback(keep, indirect=False)
        return frames, self.watcher.declare_subscriber(key, handler)

    def camera(self, name: str) -> dict[str, Any]:
        """What the newest status says of a camera."""
        return dict(self.statuses[-1].detail["cameras"][name]) if self.statuses else {}

    def wait_for(self, name: str, state: str) -> dict[str, Any]:
        return until(
            f"camera {name} {state}, is {self.camera(name)}",
            lambda: self.camera(name) if self.camera(name).get("state") == state else None,
        )

    def counter(self, name: str) -> int:
        return self.statuses[-1].counters.get(name, 0)

    def happened(self, what: str) -> list[Event]:
        return [event for event in self.events if event.what == what]


@contextmanager
def camera_rig(
    described: Mapping[str, CameraProfile],
    /,
    *,
    renderer: str = "raycast",
    hosts: Mapping[str, HostProfile] | None = None,
    **node_arguments: Any,
) -> Iterator[Rig]:
    """Serve these cameras until the block ends; `hosts` beside the one they are on."""
    endpoint = free_endpoint()
    shipped = load_profile("panda_sim")
    profile = shipped.model_copy(
        update={
            "cameras": dict(described),
            "hosts": {**shipped.hosts, **(hosts or {})},
            "session": SessionProfile(listen=(endpoint,), connect=(endpoint,)),
            "sim": shipped.sim.model_copy(update={"renderer": renderer}),
        }
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as watcher,
        open_session(profile.session) as session,
    ):
        node = CameraNode(profile, session, **node_arguments)
        stop = threading.Event()
        thread = threading.Thread(target=node.run, args=(stop,))
        rig = Rig(profile, watcher, session, node, thread, stop)

        def listen(key: str, kind: type, heard: list[Any]) -> None:
            def keep(sample: zenoh.Sample) -> None:
                heard.append(records.decode(kind, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(keep, indirect=False)
            subscribers.append(watcher.declare_subscriber(key, handler))

        subscribers: list[Any] = []
        listen(profile.keys.all_status, NodeStatus, rig.statuses)
        listen(profile.keys.all_events, Event, rig.events)
        await_match(session, profile.keys.event(node.node.name))
        thread.start()
        try:
            until("a first status", lambda: rig.statuses)
            yield rig
        finally:
            stop.set()
            thread.join(PATIENCE_S)
            assert not thread.is_alive()


def write_video(path: Path, pictures: list[np.ndarray], rate_hz: float, code: str = "FFV1") -> None:
    """BGR pictures to a video file; FFV1 loses nothing."""
    height, width = pictures[0].shape[:2]
    fourcc = cv2.VideoWriter.fourcc(*code)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, rate_hz, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()


def grey(level: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)
