"""Buffers between Zenoh's callbacks and the loops of a node, with limits on payload sizes.

An unbounded queue or a slow callback delays every sample behind it, control keys included. So a
stream keeps only its newest sample, and settings a bounded number. A sample that is a deletion or
too large is dropped before its bytes are copied, and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import zenoh

from vla_zenoh.codec import records
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Header

MAX_KEYS = 256
"""Of one buffer that are counted."""


def bytes_of(payload: zenoh.ZBytes | None, limit: int = MAX_RECORD_BYTES) -> bytes:
    """The bytes of a payload, empty if there is none; more than `limit` raise a `CodecError`."""
    if payload is None:
        return b""
    if len(payload) > limit:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {limit} are accepted")
    return payload.to_bytes()


def check_size(sample: zenoh.Sample, limit: int) -> None:
    """Raise a `CodecError` unless a sample is a put, and payload and attachment together have at
    most `limit` bytes. A deletion would look like an empty setting."""
    if sample.kind != zenoh.SampleKind.PUT:
        raise CodecError("deleted", "a deletion; only puts are accepted")
    attachment = sample.attachment
    size = len(sample.payload) + (len(attachment) if attachment is not None else 0)
    if size > limit:
        raise CodecError("oversize", f"{size} bytes, at most {limit} are accepted")


def header_of(sample: zenoh.Sample, unknown: list[str] | None = None) -> Header:
    """Header of a sample; `CodecError`: there is none that can be decoded.

    `unknown`: gets the names of fields that this version does not know.
    """
    attachment = sample.attachment
    given = None if attachment is None else bytes_of(attachment, records.MAX_HEADER_BYTES)
    return records.decode_header(given, unknown)


class ReceivedSample(NamedTuple):
    """A sample and its time of arrival, monotonic clock.

    `nth`: samples of its key that its buffer had received by then, this one included; 0: not
    counted.
    """

    sample: zenoh.Sample
    mono_ns: int
    nth: int = 0

    @property
    def put_ns(self) -> int | None:
        """When the router first saw the sample, on its clock; None: it has no timestamp."""
        stamp = self.sample.timestamp
        return None if stamp is None else round(stamp.get_time().timestamp() * 1e9)


class RejectedSample(NamedTuple):
    """Samples that a buffer rejected for one reason; key and sentence are of the newest."""

    reason: str
    key: str
    why: str
    times: int


class SampleBuffer:
    """Base of all buffers: rejects samples that have more than `limit` bytes altogether."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rejected: dict[str, RejectedSample] = {}
        self.arrived: dict[str, int] = {}
        """Key -> samples that arrived, also those that were dropped since."""

    def __call__(self, sample: zenoh.Sample) -> None:
        """Keep a sample; runs on Zenoh's thread."""
        raise NotImplementedError

    def subscribe(self, session: zenoh.Session, key: str) -> zenoh.Subscriber[Any]:
        """A subscriber whose samples go here; the caller undeclares it."""
        return session.declare_subscriber(key, zenoh.handlers.Callback(self, indirect=False))

    def _accepts(self, sample: zenoh.Sample) -> bool:
        try:
            check_size(sample, self._limit)
        except CodecError as error:
            reason, before = error.reason, self._rejected.get(error.reason)
            times = 1 if before is None else before.times + 1
            self._rejected[reason] = RejectedSample(reason, str(sample.key_expr), str(error), times)
            return False
        return True

    @property
    def count(self) -> int:
        """Samples that arrived."""
        return sum(self.arrived.values())

    def _count(self, sample: zenoh.Sample) -> int:
        """How many samples of this key arrived; 0 if there are too many keys to count."""
        key = str(sample.key_expr)
        count = self.arrived.get(key, 0) + 1
        if count == 1 and len(self.arrived) >= MAX_KEYS:
            return 0
        self.arrived[key] = count
        return count

    def pop_rejected(self) -> list[RejectedSample]:
        """Samples rejected since the last call, by reason."""
        if not self._rejected:
            return []
        found, self._rejected = self._rejected, {}
        return list(found.values())


class Wake:
    """Wakes one waiting thread: an event that clears itself, and costs half of a condition."""

    def __init__(self) -> None:
        self._asleep = threading.Lock()
        self._asleep.acquire()

    def set(self) -> None:
        """Let the present or next `wait` return."""
        with suppress(RuntimeError):  # it is set already
            self._asleep.release()

    def wait(self, timeout_s: float) -> bool:
        """Wait until it is set, since the last time; False after `timeout_s`."""
        return self._asleep.acquire(timeout=max(timeout_s, 0.0))


class CallbackRing(SampleBuffer):
    """Keeps the newest `size` samples in order; older ones are dropped and counted.

    Every sample sets `arrival`; several buffers may share one.
    """

    def __init__(
        self,
        size: int,
        limit: int = MAX_RECORD_BYTES,
        arrival: threading.Event | Wake | None = None,
    ) -> None:
        super().__init__(limit)
        self._arrival = arrival
        self._arrivals: deque[ReceivedSample] = deque(maxlen=size)
        self._size = size
        self.dropped = 0

    def __call__(self, sample: zenoh.Sample) -> None:
        if not self._accepts(sample):
            return
        if len(self._arrivals) == self._size:
            self.dropped += 1
        self._arrivals.append(ReceivedSample(sample, time.monotonic_ns(), self._count(sample)))
        if self._arrival is not None:
            self._arrival.set()

    @property
    def has_new(self) -> bool:
        """Whether there is a sample that was not popped."""
        return bool(self._arrivals)

    def pop(self) -> ReceivedSample | None:
        """The oldest sample."""
        try:
            return self._arrivals.popleft()
        except IndexError:  # none, or another thread took it
            return None

    def drain(self) -> list[ReceivedSample]:
        """All samples, oldest first."""
        return list(iter(self.pop, None))


class LatestSample(CallbackRing):
    """Keeps the newest sample; a thread can wait for it."""

    def __init__(self, limit: int = MAX_RECORD_BYTES, changed: Wake | None = None) -> None:
        self._changed = changed or Wake()
        super().__init__(1, limit, self._changed)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a sample that was not popped; False after `timeout_s`."""
        give_up_s = time.monotonic() + timeout_s
        while not self.has_new and self._changed.wait(give_up_s - time.monotonic()):
            pass
        return self.has_new


class ZenohRing(SampleBuffer):
    """A `CallbackRing` that Zenoh fills by itself, without running Python for each sample.

    A flood of samples then costs the loop that drains it nothing. The price: the time of arrival is
    that of `drain`, and samples that are too large are dropped only there: until then `size` of
    them are kept. Samples of a full ring are not counted, since others may have been dropped.
    """

    def __init__(self, size: int, limit: int = MAX_RECORD_BYTES) -> None:
        super().__init__(limit)
        self._size = size
        self._receive: Callable[[], zenoh.Sample | None] = lambda: None

    def subscribe(self, session: zenoh.Session, key: str) -> zenoh.Subscriber[Any]:
        subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(self._size))
        self._receive = subscriber.try_recv
        return subscriber

    def drain(self) -> list[ReceivedSample]:
        """At most `size` samples, oldest first, however fast they come."""
        drained: list[ReceivedSample] = []
        for _ in range(self._size):
            sample = self._receive()
            if sample is None:
                break
            if self._accepts(sample):
                drained.append(ReceivedSample(sample, time.monotonic_ns(), self._count(sample)))
        else:
            return [arrival._replace(nth=0) for arrival in drained]
        return drained
