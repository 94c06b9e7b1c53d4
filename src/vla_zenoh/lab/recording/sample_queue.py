"""A bounded queue between Zenoh's callbacks and the thread that uses the samples."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of, check_size
from vla_zenoh.bus.clock import Clock
from vla_zenoh.errors import CodecError, RecordingError
from vla_zenoh.lab.recording.sample import Sample, received_sample

CHANNEL = 256
"""Samples that wait in Zenoh for the thread that takes settings."""


class SampleQueue:
    """Subscribes to keys and keeps their samples in the order of reception until `take`.

    Settings, which any client may put as fast as it likes, are taken by a thread, many at once:
    Zenoh would wait for Python at every single one, and a router closes a link that is too slow.

    Args:
        session: an open session; the caller closes it.
        max_bytes: payloads and attachments kept at most, the samples last taken included.
        max_samples: kept at most; half as many of one key, so that a flood leaves room for others.
    """

    def __init__(
        self,
        session: zenoh.Session,
        *,
        max_bytes: int,
        max_samples: int,
    ) -> None:
        self.clock = Clock()
        """Of the times of reception. It is never set, so that they are in the order of arrival."""
        self.dropped: Counter[str] = Counter()
        """Samples that did not fit, by key."""
        self.rejected: Counter[str] = Counter()
        """Deletions, which carry no sample, by reason."""
        self.deletions: deque[str] = deque(maxlen=1000)
        """Keys of the newest ones."""
        self.arrived: Counter[str] = Counter()
        """Samples that arrived, those that did not fit included, by key."""
        self._session = session
        self._max_bytes, self._max_samples = max_bytes, max_samples
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes, str, bytes | None, int, str]] = deque()
        self._waiting: Counter[str] = Counter()
        self._bytes = self._taken_bytes = 0
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        self._thread: threading.Thread | None = None

    def subscribe(self, expressions: Iterable[str], settings: str = "") -> None:
        """Receive the samples of key expressions.

        Args:
            settings: the expression of them that stands for settings.

        Raises:
            RecordingError: not a key expression.
        """
        handler = zenoh.handlers.Callback(self.receive, indirect=False)
        for expression in expressions:
            channel = zenoh.handlers.FifoChannel(CHANNEL) if expression == settings else handler
            try:
                subscriber = self._session.declare_subscriber(expression, channel)
            except zenoh.ZError as error:
                raise RecordingError(f"{expression!r} is not a key expression: {error}") from error
            self._subscribers.append(subscriber)
            if expression == settings:
                self._thread = threading.Thread(
                    target=self._receive_from, args=(subscriber.handler,), daemon=True
                )
                self._thread.start()

    def _receive_from(self, channel: Any) -> None:
        with suppress(zenoh.ZError):  # empty, and the subscriber is closed
            while True:
                sample = channel.recv()
                while sample is not None:
                    self.receive(sample)
                    sample = channel.try_recv()

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
                    self.deletions.append(key)
            return
        header = bytes_of(sample.attachment, self._max_bytes)
        attachment = None if sample.attachment is None else header
        payload = bytes_of(sample.payload, self._max_bytes)
        source = sample.source_info if attachment is None else None
        client = "" if source is None else str(source.source_id.zid)
        self.add(key, payload, str(sample.encoding), attachment, client)

    def add(
        self, key: str, payload: bytes, encoding: str, attachment: bytes | None, client: str = ""
    ) -> None:
        """Add a sample; it is dropped and counted when the queue is full."""
        size = len(payload) + len(attachment or b"")
        with self._lock:
            full = self._bytes + self._taken_bytes + size > self._max_bytes
            flood = self._waiting[key] >= self._max_samples // 2
            if full or flood or len(self._queue) >= self._max_samples:
                self.dropped[key] += 1
                return
            self._waiting[key] += 1
            # The stamp is taken under the lock: the queue is in the order of its stamps.
            received_ns = self.clock.wall_ns()
            self._queue.append((key, payload, encoding, attachment, received_ns, client))
            self._bytes += size

    def take(self) -> list[Sample]:
        """All samples since the last call; they count against the bounds until the next one."""
        with self._lock:
            taken, self._queue = self._queue, deque()
            self._waiting.clear()
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
        if self._thread is not None:
            self._thread.join()
