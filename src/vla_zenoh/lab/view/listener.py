"""Listens to everything a robot says, for whoever shows it. It says nothing itself."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import payload_and_attachment
from vla_zenoh.bus.clock import Clock
from vla_zenoh.errors import CodecError
from vla_zenoh.lab.recording.sample import Sample, heard
from vla_zenoh.profile import Profile

QUEUE_BYTES = 16 * 1024 * 1024
QUEUE_SAMPLES = 8_000
"""Some ten seconds: who shows later than that shows the past."""
ANSWER_S = 1.0


class ViewListener:
    """Keeps what is said until it is taken, up to a bound.

    Workers show what their models see, and cameras make JPEG, because this listens.

    Args:
        session: an open session, closed by whoever opened it.
        profile: of the robot.
        queue_bytes: payloads kept at most; what does not fit is counted.
    """

    def __init__(
        self, session: zenoh.Session, profile: Profile, *, queue_bytes: int = QUEUE_BYTES
    ) -> None:
        self.keys = profile.keys
        self.dropped: Counter[str] = Counter()
        """Samples that did not fit, or put nothing, by key."""
        self._clock = Clock()
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes, str, bytes | None, int]] = deque()
        self._queued_bytes, self._queue_limit = 0, queue_bytes
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscribers: list[Any] = [
            session.declare_subscriber(key, handler) for key in self.keys.without_raw_images
        ]
        # Specs come once a second, and chunks cannot be read without.
        for reply in session.get(self.keys.all_specs, timeout=ANSWER_S):
            if reply.ok is not None:
                self._take(reply.ok)

    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        try:
            payload, header = payload_and_attachment(sample, self._queue_limit)
        except CodecError:
            with self._lock:
                self.dropped[key] += 1
            return
        size = len(payload) + len(header or b"")
        with self._lock:
            full = self._queued_bytes + size > self._queue_limit
            if full or len(self._queue) >= QUEUE_SAMPLES:
                self.dropped[key] += 1
                return
            now_ns = self._clock.wall_ns()
            self._queue.append((key, payload, str(sample.encoding), header, now_ns))
            self._queued_bytes += size

    def take(self) -> list[Sample]:
        """All that came since the last call, in the order heard."""
        with self._lock:
            taken, self._queue = self._queue, deque()
            self._queued_bytes = 0
        return [heard(*each) for each in taken]

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
