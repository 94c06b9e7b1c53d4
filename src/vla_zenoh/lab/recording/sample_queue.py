"""A bounded queue between Zenoh's callbacks and the thread that uses the samples."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable

import zenoh

from vla_zenoh.bus.buffers import bytes_of, check_size
from vla_zenoh.bus.clock import Clock
from vla_zenoh.errors import CodecError, RecordingError
from vla_zenoh.lab.recording.sample import Sample, received_sample


class SampleQueue:
    """Subscribes to keys and keeps their samples in the order of reception until `take`.

    Args:
        session: an open session; the caller closes it.
        max_bytes: payloads and attachments kept at most, the samples last taken included.
    """

    def __init__(
        self,
        session: zenoh.Session,
        *,
        max_bytes: int,
        max_samples: int,
        clock: Clock | None = None,
    ) -> None:
        self.dropped: Counter[str] = Counter()
        """Samples that did not fit, by key."""
        self.rejected: Counter[str] = Counter()
        """Deletions, which carry no sample, by reason."""
        self.arrived: Counter[str] = Counter()
        """Samples that arrived, those that did not fit included, by key."""
        self._session, self._clock = session, clock or Clock()
        self._max_bytes, self._max_samples = max_bytes, max_samples
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes, str, bytes | None, int]] = deque()
        self._bytes = self._taken_bytes = 0
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def subscribe(self, expressions: Iterable[str]) -> None:
        """Receive the samples of key expressions. Raises RecordingError: not a key expression."""
        handler = zenoh.handlers.Callback(self.receive, indirect=False)
        for expression in expressions:
            try:
                subscriber = self._session.declare_subscriber(expression, handler)
            except zenoh.ZError as error:
                raise RecordingError(f"{expression!r} is not a key expression: {error}") from error
            self._subscribers.append(subscriber)

    def receive(self, sample: zenoh.Sample) -> None:
        """Add a sample from Zenoh, also from the reply to a query."""
        key = str(sample.key_expr)
        self.arrived[key] += 1
        try:
            check_size(sample, self._max_bytes)
        except CodecError as error:  # copying an oversized one costs as much as keeping it
            with self._lock:
                if error.reason == "oversize":
                    self.dropped[key] += 1
                else:
                    self.rejected[error.reason] += 1
            return
        header = bytes_of(sample.attachment, self._max_bytes)
        attachment = None if sample.attachment is None else header
        self.add(key, bytes_of(sample.payload, self._max_bytes), str(sample.encoding), attachment)

    def add(self, key: str, payload: bytes, encoding: str, attachment: bytes | None) -> None:
        """Add a sample; it is dropped and counted when the queue is full."""
        size = len(payload) + len(attachment or b"")
        with self._lock:
            full = self._bytes + self._taken_bytes + size > self._max_bytes
            if full or len(self._queue) >= self._max_samples:
                self.dropped[key] += 1
                return
            # The stamp is taken under the lock: the queue is in the order of its stamps.
            self._queue.append((key, payload, encoding, attachment, self._clock.wall_ns()))
            self._bytes += size

    def take(self) -> list[Sample]:
        """All samples since the last call; they count against the bounds until the next one."""
        with self._lock:
            taken, self._queue = self._queue, deque()
            self._bytes, self._taken_bytes = 0, self._bytes
        return [received_sample(*each) for each in taken]

    def reject_all(self) -> None:
        """Empty the queue and drop all further samples."""
        with self._lock:
            self._max_bytes = -1
            self._queue.clear()

    def close(self) -> None:
        """Receive no more samples; those in the queue stay until `take`."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
