"""Writes what is said on keys into a file, and says on its own keys how that goes.

Zenoh's callback only puts a sample into a queue of bounded size; a thread writes. What the queue
cannot take is counted by key, in status and in the file.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of, payload_and_attachment
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError, RecordingError
from vla_zenoh.keys import Keys, covers
from vla_zenoh.lab.recording.sample import TEXT, heard
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.types import Event

NAME = "recorder"
QUEUE_BYTES = 64 * 1024 * 1024
QUEUE_SAMPLES = 50_000
"""Some ten seconds of a robot with two cameras."""
COMMIT_S = 0.5
"""Who kills the recorder with -9 loses at most what was said in this time."""
POLL_S = 0.1
ANSWER_S = 1.0
SWITCH_INTERVAL_S = 5e-4
RECORDING, FAILED, STOPPED = "recording", "failed", "stopped"


@dataclass(slots=True)
class RecordingResult:
    """What became of a recording.

    Args:
        path: of the file.
        seconds: how long it was recorded.
        size_bytes: of the file.
        cpu_s: processor time that writing took, without Zenoh's threads.
        samples: by key.
        dropped: by key, because the disk did not keep up.
        failure: why it ended early; empty when it did not.
    """

    path: Path
    seconds: float = 0.0
    size_bytes: int = 0
    cpu_s: float = 0.0
    samples: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    failure: str = ""


def recorded_keys(keys: Keys, given: Sequence[str] = (), *, raw: bool = False) -> tuple[str, ...]:
    """Which key expressions are recorded.

    Args:
        keys: of the robot.
        given: these alone, below ``<root>/<robot>/`` or whole; empty: everything the robot says
            but raw pictures, which are 1 MB each.
        raw: raw pictures too.
    """
    found = dict.fromkeys(map(keys.full, given)) or dict.fromkeys(keys.without_raw_images)
    if raw:
        found[keys.all_raw_images] = None
    # What two expressions mean would be heard, and recorded, twice.
    return tuple(
        each for each in found if not any(covers(other, each) for other in found if other != each)
    )


class Recorder:
    """Records from `start` to `close`.

    Args:
        profile: the effective profile; it goes into the file.
        session: an open session, closed by whoever opened it.
        path: of the file.
        expressions: which keys, see `recorded_keys`; None: what that gives by itself.
        name: the node's; a second recorder needs another one.
        queue_bytes: payloads in memory at most.

    Raises:
        RecordingError: the file cannot be made.
        NodeError: a node of this name is alive already.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        path: Path,
        *,
        expressions: Sequence[str] | None = None,
        name: str = NAME,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self.node = Node(name, profile, session)
        self._expressions = expressions or recorded_keys(self.node.keys)
        self._queue: deque[tuple[str, bytes, str, bytes | None, int]] = deque()
        self._queued_bytes, self._queue_limit = 0, queue_bytes
        self._change = threading.Condition()
        self._closing = False
        self._ended: Mapping[str, Any] = {}
        self._subscribers: list[Any] = []
        self.recorded = RecordingResult(path)
        self._began_s = time.monotonic()
        self._writer = RecordingWriter(
            path,
            self.node.keys,
            profile_yaml=to_yaml(profile),
            base_frame=profile.robot.base_frame,
            began_ns=self.node.clock.wall_ns(),
            about={"profile": profile.name, "keys": " ".join(self._expressions)},
        )
        self._thread = threading.Thread(target=self._write_all, name=name, daemon=True)

    # -- life ---------------------------------------------------------------------------------
    def start(self) -> Recorder:
        """Begin to listen.

        Raises:
            RecordingError: not a key expression.
        """
        # Else Zenoh's thread may wait 5 ms for the writing one at every sample, and hears late.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        for expression in self._expressions:
            try:
                subscriber = self.node.session.declare_subscriber(expression, handler)
            except zenoh.ZError as error:
                raise RecordingError(f"{expression!r} is not a key expression: {error}") from error
            self._subscribers.append(subscriber)
        self._thread.start()
        self._ask_settings()
        return self

    def _ask_settings(self) -> None:
        """Settings are put once and kept by the command node: those in force stand at the top."""
        keys = self.node.keys
        wanted = [zenoh.KeyExpr(expression) for expression in self._expressions]
        for key in (keys.prompt, keys.worker, keys.rate, keys.speed, keys.active):
            if not any(expression.includes(zenoh.KeyExpr(key)) for expression in wanted):
                continue
            for reply in self.node.session.get(key, timeout=ANSWER_S):
                if reply.ok is not None:
                    self._put(key, bytes_of(reply.ok.payload), TEXT, None)

    def run(self, stop: threading.Event, seconds: float | None = None) -> RecordingResult:
        """Record until `stop` is set, `seconds` have passed, or the disk is full."""
        end_s = None if seconds is None else time.monotonic() + seconds
        self.start()
        while not stop.is_set() and not self.recorded.failure:
            left_s = POLL_S if end_s is None else min(POLL_S, end_s - time.monotonic())
            if left_s <= 0:
                break
            stop.wait(left_s)
        return self.close()

    def stop_listening(self) -> None:
        """Take no more samples; the file stays open until `close`."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()

    def close(self, ended: Mapping[str, Any] | None = None) -> RecordingResult:
        """Stop listening, write what is queued, and finish the file.

        Args:
            ended: what else is to stand at its end.
        """
        self.stop_listening()
        self._ended = ended or {}
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join()
        self.node.close()
        return self.recorded

    # -- in -----------------------------------------------------------------------------------
    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        try:
            payload, attachment = payload_and_attachment(sample, self._queue_limit)
        except CodecError as error:  # copying what is too large costs as much as keeping it
            with self._change:
                if error.reason == "oversize":
                    self.recorded.dropped[key] += 1
                else:
                    self.node.counters[f"refused.{error.reason}"] += 1
            return
        self._put(key, payload, str(sample.encoding), attachment)

    def _put(self, key: str, payload: bytes, encoding: str, attachment: bytes | None) -> None:
        size = len(payload) + len(attachment or b"")
        with self._change:
            full = self._queued_bytes + size > self._queue_limit
            if full or len(self._queue) >= QUEUE_SAMPLES:
                self.recorded.dropped[key] += 1
                return
            # The stamp is taken under the lock: the file is in the order of its stamps.
            now_ns = self.node.clock.wall_ns()
            self._queue.append((key, payload, encoding, attachment, now_ns))
            self._queued_bytes += size
            if len(self._queue) == 1:
                self._change.notify()

    # -- out ----------------------------------------------------------------------------------
    def _write_all(self) -> None:
        try:
            self._write_until_closed()
            self._writer.finish({"dropped": dict(self.recorded.dropped), **self._ended})
        except RecordingError as error:
            self._fail(str(error))
        self._measure()
        self.recorded.size_bytes = self.recorded.path.stat().st_size
        self._report(FAILED if self.recorded.failure else STOPPED, now=True)

    def _write_until_closed(self) -> None:
        commit_s = time.monotonic() + COMMIT_S
        closing = False
        while not closing:
            with self._change:
                self._change.wait_for(lambda: self._queue or self._closing, POLL_S)
                closing = self._closing
                taken, self._queue = self._queue, deque()
                taken_bytes = self._queued_bytes
            for each in taken:
                self._writer.write(heard(*each))
            taken.clear()
            with self._change:
                self._queued_bytes -= taken_bytes
            if time.monotonic() >= commit_s:
                self._writer.commit()
                commit_s = time.monotonic() + COMMIT_S
                self._measure()
                self._report(RECORDING)
            elif not closing:
                # Samples are written some at a time: waking up for each costs more than they do.
                time.sleep(POLL_S / 4)

    def _fail(self, why: str) -> None:
        with self._change:
            self.recorded.failure = why
            self._queue_limit = -1  # nothing is queued any more
            self._queue.clear()
        self._writer.abandon()
        self.node.emit(Event("error", "fault", "recording_failed", why[:1000]))

    def _measure(self) -> None:
        self.recorded.seconds = time.monotonic() - self._began_s
        self.recorded.size_bytes = self._writer.size
        self.recorded.samples = self._writer.counts
        self.recorded.cpu_s = time.thread_time()

    def _report(self, state: str, *, now: bool = False) -> None:
        recorded = self.recorded
        dropped = recorded.dropped.total()
        if dropped > self.node.counters["dropped"]:
            self.node.emit(
                Event(
                    "error",
                    "fault",
                    "samples_dropped",
                    "the disk does not keep up: samples are missing in the recording",
                    value=float(dropped),
                )
            )
        self.node.counters["samples"] = recorded.samples.total()
        self.node.counters["dropped"] = dropped
        self.node.publish_status(
            state,
            detail={
                "file": str(recorded.path),
                "size_bytes": recorded.size_bytes,
                "seconds": round(recorded.seconds, 1),
                "why": recorded.failure,
            },
            now=now,
        )
