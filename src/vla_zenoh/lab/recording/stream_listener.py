"""Live streams of a robot, decoded and kept in memory with their times of reception."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

import zenoh

from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.run import RecordedSample
from vla_zenoh.lab.recording.sample_queue import SampleQueue
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)

QUEUE_BYTES, QUEUE_SAMPLES = 64 * 1024 * 1024, 50_000
POLL_S = 0.05
JOIN_PATIENCE_S = 10.0


@dataclass(slots=True)
class Streams:
    """Received records, oldest first; unbounded, a minute takes some 40 MB."""

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
        """The last TCP pose received."""
        return self.poses[-1].record if self.poses else None


class StreamListener:
    """Fills `Streams` from the keys of one robot until `close`.

    Args:
        session: an open session; the caller closes it.
        keys: of the robot.
        worker: whose chunks to receive.
        keep: records of each kind kept at least; None: all.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, worker: str, *, keep: int | None = None
    ) -> None:
        self.streams = streams = Streams()
        self._worker, self._keep = worker, keep
        self._chunk_steps: dict[int, tuple[int, int]] = {}  # chunk -> episode, steps
        self._executed: set[int] = set()  # chunks that a command named as its cause
        self._targets: dict[str, tuple[type, list[RecordedSample]]] = {
            keys.state_pose: (PoseState, streams.poses),
            keys.state_joint: (JointState, streams.joints),
            keys.state_gripper: (GripperState, streams.grippers),
            keys.command_pose: (PoseCommand, streams.commands),
            keys.command_joint: (JointCommand, streams.joint_commands),
            keys.delta(worker): (ActionChunk, streams.chunks),
        }
        self._queue = SampleQueue(session, max_bytes=QUEUE_BYTES, max_samples=QUEUE_SAMPLES)
        self._queue.subscribe(self._targets)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._decode_all, daemon=True)
        self._thread.start()

    def steps_carried_out(self, episode: int) -> int:
        """Steps of the chunks of `episode` that a command named as its cause."""
        steps = (self._chunk_steps.get(chunk, (-1, 0)) for chunk in list(self._executed))
        return sum(count for of, count in steps if of == episode)

    def _decode_all(self) -> None:
        closing = False
        while not closing:
            closing = self._closing.wait(POLL_S)
            for sample in self._queue.take():
                kind, stream = self._targets[sample.key]
                try:
                    record = records.decode(kind, sample.payload)
                except CodecError:
                    continue  # the nodes themselves count and report what they reject
                if sample.header is not None:
                    received = (sample.header, record, sample.received_ns, sample.key)
                    self._keep_record(stream, RecordedSample(*received))

    def _keep_record(self, stream: list[RecordedSample], received: RecordedSample) -> None:
        record = received.record
        if isinstance(record, ActionChunk):
            self._chunk_steps[received.header.seq] = (record.episode, len(record.steps))
        elif isinstance(record, (PoseCommand, JointCommand)):
            cause = record.cause
            if cause is not None and cause.worker == self._worker:
                self._executed.add(cause.chunk_seq)
        stream.append(received)
        if self._keep is not None and len(stream) > 2 * self._keep:
            del stream[: -self._keep]

    def close(self) -> Streams:
        """Stop receiving; the streams are complete afterwards."""
        self._queue.close()
        self._closing.set()
        self._thread.join(JOIN_PATIENCE_S)
        return self.streams
