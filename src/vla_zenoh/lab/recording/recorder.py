"""Records the keys of a robot into a file, as a node with its own status and events."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh import __version__
from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.reception import Share
from vla_zenoh.bus.session import covers
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, in_words
from vla_zenoh.keys import ENDED, Keys
from vla_zenoh.lab.recording.record_types import record_of
from vla_zenoh.lab.recording.sample import TEXT
from vla_zenoh.lab.recording.sample_queue import SampleQueue
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.types import Event

NAME = "recorder"
QUEUE_BYTES = 64 * 1024 * 1024
QUEUE_SAMPLES = 50_000
"""About ten seconds of a robot with two cameras."""
COMMIT_S = 0.5
"""A recorder killed with -9 loses at most the samples of this period."""
POLL_S, WRITE_S = 0.1, 0.025
ANSWER_S = 1.0
GIT_S = 2.0
SWITCH_INTERVAL_S = 5e-4
RECORDING, FAILED = "recording", "failed"


def code_version() -> str:
    """Version of this package, and the commit where it runs from a checkout."""
    package = Path(__file__).resolve().parents[2]
    if not (package.parents[1] / ".git").exists():
        return __version__
    words = ("git", "-C", str(package), "describe", "--always", "--dirty")
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=GIT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return __version__
    return f"{__version__}, commit {done.stdout.strip()}"


@dataclass(slots=True)
class RecordingResult:
    """Result of a recording.

    Args:
        dropped: samples by key that the disk was too slow for.
        streams: key -> samples that its sender announced in its status, and that are recorded.
        lost: samples by key that never arrived.
        unreadable, unreadable_why: records of another version of the wire, which no reader of this
            file knows, and which side is to be updated.
        failure: why it ended early; empty if it did not.
    """

    path: Path
    seconds: float = 0.0
    size_bytes: int = 0
    samples: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    streams: dict[str, Share] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    unreadable: int = 0
    unreadable_why: str = ""
    failure: str = ""


def recorded_keys(keys: Keys, given: Sequence[str] = (), *, raw: bool = False) -> tuple[str, ...]:
    """Key expressions to record.

    Args:
        given: only these, below ``<root>/<robot>/`` or whole; empty: all keys of the robot but raw
            images, which are 1 MB each.
    """
    found = dict.fromkeys(map(keys.full, given)) or dict.fromkeys(keys.without_raw_images)
    if raw:
        found[keys.all_raw_images] = None
    # A key that two expressions match would be received, and recorded, twice.
    kept: list[str] = []
    for each in found:
        if not any(covers(other, each) for other in kept):
            kept = [other for other in kept if not covers(each, other)] + [each]
    return tuple(kept)


class Recorder:
    """Node that records the keys of a robot from `start` to `close`.

    Args:
        profile: the effective profile; it is kept in the file.
        session: an open session; the caller closes it.
        expressions: keys to record; None: the default of `recorded_keys`.
        name: node name; a second recorder needs another one.
        queue_bytes: payloads in memory at most.
        about: further metadata of the run, kept at the start of the file.

    Raises:
        RecordingError: the file exists or cannot be created.
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
        about: Mapping[str, str] | None = None,
    ) -> None:
        self.node = Node(name, profile, session)
        self._expressions = expressions or recorded_keys(profile.keys_of_all_parts)
        self._queue = SampleQueue(session, max_bytes=queue_bytes, max_samples=QUEUE_SAMPLES)
        self._closing = threading.Event()
        self._shares: dict[str, Share] = {}
        self._ended: Mapping[str, Any] = {}
        self.recorded = RecordingResult(path, dropped=self._queue.dropped)
        self._began_s = time.monotonic()
        with ExitStack() as undo:
            undo.callback(self.node.close)
            self._writer = RecordingWriter(
                path,
                self.node.keys,
                profile_yaml=to_yaml(profile),
                base_frame=profile.robot.base_frame,
                began_ns=self.node.clock.wall_ns(),
                about={
                    "profile": profile.name,
                    "keys": " ".join(self._expressions),
                    "host": socket.gethostname(),
                    "code": code_version(),
                    **(about or {}),
                },
            )
            undo.pop_all()
        self._thread = threading.Thread(target=self._write_all, name=name, daemon=True)

    # -- life ---------------------------------------------------------------------------------
    def start(self) -> Recorder:
        """Subscribe and begin to record. Raises RecordingError: not a key expression."""
        # With Python's default of 5 ms, Zenoh's thread may wait that long for the writing thread.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self._thread.start()
        with ExitStack() as undo:
            undo.callback(self.close)
            self.node.follow_senders()
            self._queue.subscribe(self._expressions)
            for expression in self._expressions:
                self.node.reception.watch(expression, self._queue.arrived)
            self._ask_settings()
            undo.pop_all()
        return self

    def _ask_settings(self) -> None:
        """Ask the command node for the settings in force: each is published only once."""
        keys = self.node.keys
        wanted = [zenoh.KeyExpr(expression) for expression in self._expressions]
        for key in (keys.prompt, keys.worker, keys.rate, keys.speed, keys.active):
            if not any(expression.includes(zenoh.KeyExpr(key)) for expression in wanted):
                continue
            for reply in self.node.session.get(key, timeout=ANSWER_S):
                if reply.ok is not None:
                    self._queue.add(key, bytes_of(reply.ok.payload), TEXT, None)

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
        """Unsubscribe; the file stays open until `close`."""
        self._shares = self._shares or self.node.reception.shares()
        self.node.reception.unwatch(self._queue.arrived)  # what is sent from now on is not lost
        self._queue.close()

    def close(self, ended: Mapping[str, Any] | None = None) -> RecordingResult:
        """Unsubscribe, write the queued samples and finish the file."""
        self.stop_listening()
        self._ended = ended or {}
        self._closing.set()
        self._thread.join()
        self.node.close()
        return self.recorded

    # -- out ----------------------------------------------------------------------------------
    def _write_all(self) -> None:
        try:
            self._write_until_closed()
            self._count_lost()
            facts = {"dropped": dict(self.recorded.dropped), "lost": dict(self.recorded.lost)}
            self._writer.finish({**facts, **self._ended})
        except Exception as error:  # whatever it is, nothing is recorded any more
            self._fail(in_words(error))
        self._measure()
        with suppress(OSError):  # it was removed
            self.recorded.size_bytes = self.recorded.path.stat().st_size
        self._report(FAILED if self.recorded.failure else ENDED, now=True)

    def _write_until_closed(self) -> None:
        commit_s = time.monotonic() + COMMIT_S
        closing = False
        while not closing:
            # Samples are written in batches: waking up for each costs more than writing it.
            closing = self._closing.wait(WRITE_S)
            for sample in self._queue.take():
                self._writer.write(sample)
                if sample.header is not None:
                    arrived = self._writer.counts[sample.key] + self._queue.dropped[sample.key]
                    self.node.traffic.received(sample.key, sample.header, arrived)
                elif sample.attachment and record_of(self.node.keys.short(sample.key)):
                    self._count_unreadable(sample.attachment)
            if time.monotonic() >= commit_s:
                self._writer.commit()
                commit_s = time.monotonic() + COMMIT_S
                self._measure()
                self._report(RECORDING)

    def _count_unreadable(self, attachment: bytes) -> None:
        try:
            records.decode_header(attachment)
        except CodecError as error:
            if error.reason == "schema":
                self.recorded.unreadable += 1
                self.recorded.unreadable_why = str(error)

    def _count_lost(self) -> None:
        dropped, lost = self._queue.dropped, Counter(self.node.traffic.lost)
        for key, (sent, received) in self._shares.items():
            self.recorded.streams[key] = Share(sent, received - dropped[key])
            lost[key] = max(lost[key], Share(sent, received).lost)
        self.recorded.lost = +lost

    def _fail(self, why: str) -> None:
        self.recorded.failure = why
        self._queue.reject_all()
        self._writer.abandon()
        self.node.emit(Event("error", "fault", "recording_failed", why[:1000]))

    def _measure(self) -> None:
        self.recorded.seconds = time.monotonic() - self._began_s
        self.recorded.size_bytes = self._writer.size
        self.recorded.samples = self._writer.counts

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
        for reason, count in self._queue.rejected.items():
            self.node.counters[f"refused.{reason}"] = count
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
