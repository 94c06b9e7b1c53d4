"""What a run looks like from outside while it goes on: streams in memory, with times of arrival."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import zenoh

from vla_zenoh.bus.buffers import payload_and_attachment
from vla_zenoh.codec import records
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.run import RecordedSample
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

Record = TypeVar("Record")


@dataclass(slots=True)
class Streams:
    """What was heard; without a bound a minute is some 40 MB."""

    poses: list[RecordedSample] = field(default_factory=list)
    joints: list[RecordedSample] = field(default_factory=list)
    grippers: list[RecordedSample] = field(default_factory=list)
    commands: list[RecordedSample] = field(default_factory=list)
    joint_commands: list[RecordedSample] = field(default_factory=list)
    chunks: list[RecordedSample] = field(default_factory=list)
    marks: list[tuple[int, str]] = field(default_factory=list)

    def mark(self, prompt: str) -> None:
        """Note that `prompt` begins now."""
        self.marks.append((time.time_ns(), prompt))

    def newest_pose(self) -> PoseState | None:
        """The last TCP pose heard."""
        return self.poses[-1].record if self.poses else None


class StreamListener:
    """Fills `Streams` from the keys of one robot until `close`.

    Args:
        session: open session.
        keys: of the robot.
        worker: whose chunks to hear.
        keep: how many of each kind are kept at least; None: all.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, worker: str, *, keep: int | None = None
    ) -> None:
        self.streams = Streams()
        self._keep = keep
        self._steps: dict[int, tuple[int, int]] = {}  # chunk -> episode, steps
        self._named: set[int] = set()  # chunks that a command named
        self._worker = worker
        self._queue: list[tuple[str, str, bytes, bytes | None, int]] = []
        self._ready = threading.Condition()
        self._closed = False
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
        self._thread = threading.Thread(target=self._decode_all, daemon=True)
        self._thread.start()

    def steps_carried_out(self, episode: int) -> int:
        """Steps of the chunks of `episode` that a command named as its cause."""
        steps = (self._steps.get(chunk, (-1, 0)) for chunk in list(self._named))
        return sum(count for of, count in steps if of == episode)

    def _into(self, name: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            try:
                payload, head = payload_and_attachment(sample, MAX_RECORD_BYTES)
            except CodecError:
                return
            entry = (name, str(sample.key_expr), payload, head, time.time_ns())
            with self._ready:
                self._queue.append(entry)

        return take

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
            for name, key, payload, attachment, received_ns in queue:
                try:
                    heard = RecordedSample(
                        records.decode_header(attachment),
                        records.decode(kinds[name], payload),
                        received_ns,
                        key,
                    )
                except CodecError:
                    continue  # the nodes themselves count and tell what they refuse
                self._take(getattr(self.streams, name), heard)

    def _take(self, stream: list[RecordedSample], heard: RecordedSample) -> None:
        record = heard.record
        if isinstance(record, ActionChunk):
            self._steps[heard.header.seq] = (record.episode, len(record.steps))
        elif isinstance(record, (PoseCommand, JointCommand)):
            cause = record.cause
            if cause is not None and cause.worker == self._worker:
                self._named.add(cause.chunk_seq)
        stream.append(heard)
        if self._keep is not None and len(stream) > 2 * self._keep:
            del stream[: -self._keep]

    def close(self) -> Streams:
        """Stop listening; the streams are complete afterwards."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._closed = True
        self._thread.join(10.0)
        return self.streams
