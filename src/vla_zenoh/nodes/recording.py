"""What a run looked like from outside: everything heard on the keys, with times of arrival."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import zenoh

from vla_zenoh.codec import header as header_codec
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    Header,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Heard:
    """A record, its header, and when it was heard (wall clock here)."""

    header: Header
    record: Any
    heard_ns: int


@dataclass(slots=True)
class Recording:
    """All of a run, in memory; a minute is some 40 MB."""

    poses: list[Heard] = field(default_factory=list)
    joints: list[Heard] = field(default_factory=list)
    grippers: list[Heard] = field(default_factory=list)
    commands: list[Heard] = field(default_factory=list)
    joint_commands: list[Heard] = field(default_factory=list)
    chunks: list[Heard] = field(default_factory=list)
    frames: list[tuple[int, bytes]] = field(default_factory=list)
    marks: list[tuple[int, str]] = field(default_factory=list)

    def mark(self, prompt: str) -> None:
        """Note that `prompt` begins now."""
        self.marks.append((time.time_ns(), prompt))

    def newest_pose(self) -> PoseState | None:
        """The last TCP pose heard."""
        return self.poses[-1].record if self.poses else None


class Recorder:
    """Fills a `Recording` from the keys of one robot while the context lasts.

    Args:
        session: open session.
        keys: of the robot.
        worker: whose chunks to record.
        camera: whose JPEG pictures to record, None: no video.
        frames_hz: at most so many pictures a second.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        worker: str,
        camera: str | None,
        frames_hz: float = 15.0,
    ) -> None:
        self.recording = Recording()
        self._frame_ns = int(0.9e9 / frames_hz)
        self._queue: list[tuple[str, bytes, bytes | None, int]] = []
        self._ready = threading.Condition()
        self._closed = False
        self._last_frame_ns = 0
        named = {
            "poses": keys.state_pose,
            "joints": keys.state_joint,
            "grippers": keys.state_gripper,
            "commands": keys.command_pose,
            "joint_commands": keys.command_joint,
            "chunks": keys.delta(worker),
        }
        self._subscribers = [
            session.declare_subscriber(
                key, zenoh.handlers.Callback(self._into(name), indirect=False)
            )
            for name, key in named.items()
        ]
        if camera is not None:
            handler = zenoh.handlers.Callback(self._take_frame, indirect=False)
            self._subscribers.append(session.declare_subscriber(keys.camera_jpeg(camera), handler))
        self._thread = threading.Thread(target=self._decode_all, daemon=True)
        self._thread.start()

    def _into(self, name: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            entry = (
                name,
                sample.payload.to_bytes(),
                attachment.to_bytes() if attachment is not None else None,
                time.time_ns(),
            )
            with self._ready:
                self._queue.append(entry)

        return take

    def _take_frame(self, sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        if now_ns - self._last_frame_ns >= self._frame_ns:
            self._last_frame_ns = now_ns
            self.recording.frames.append((now_ns, sample.payload.to_bytes()))

    def _decode_all(self) -> None:
        kinds = {
            "poses": PoseState,
            "joints": JointState,
            "grippers": GripperState,
            "commands": PoseCommand,
            "joint_commands": JointCommand,
            "chunks": ActionChunk,
        }
        while not self._closed or self._queue:
            time.sleep(0.05)
            with self._ready:
                queue, self._queue = self._queue, []
            for name, payload, attachment, heard_ns in queue:
                try:
                    heard = Heard(
                        header_codec.decode(attachment),
                        records.decode(kinds[name], payload),
                        heard_ns,
                    )
                except CodecError:
                    continue  # the nodes themselves count and tell what they refuse
                getattr(self.recording, name).append(heard)

    def close(self) -> Recording:
        """Stop listening; the recording is complete afterwards."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._closed = True
        self._thread.join(10.0)
        return self.recording
