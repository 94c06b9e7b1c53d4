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
from typing import NamedTuple

import zenoh

from vla_zenoh.codec import records
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Header


def bytes_of(payload: zenoh.ZBytes | None, limit: int = MAX_RECORD_BYTES) -> bytes:
    """The bytes; none are empty.

    Raises:
        CodecError: ``oversize``, more than `limit`.
    """
    if payload is None:
        return b""
    if len(payload) > limit:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {limit} are taken")
    return payload.to_bytes()


def check_size(sample: zenoh.Sample, limit: int) -> None:
    """Whether a sample may be taken. A deletion comes without bytes, and would pass for a setting.

    Raises:
        CodecError: ``deleted``, it was not put; ``oversize``, payload and attachment together are
            more than `limit`.
    """
    if sample.kind != zenoh.SampleKind.PUT:
        raise CodecError("deleted", "nothing is deleted here; what is put is taken")
    attachment = sample.attachment
    size = len(sample.payload) + (len(attachment) if attachment is not None else 0)
    if size > limit:
        raise CodecError("oversize", f"{size} bytes, at most {limit} are taken")


def payload_and_attachment(sample: zenoh.Sample, limit: int) -> tuple[bytes, bytes | None]:
    """Payload and attachment.

    Raises:
        CodecError: as `check` says.
    """
    check_size(sample, limit)
    attachment = sample.attachment
    return sample.payload.to_bytes(), attachment.to_bytes() if attachment is not None else None


def header_of(sample: zenoh.Sample) -> Header:
    """What the sample's writer says of it.

    Raises:
        CodecError: it has no header that can be read.
    """
    attachment = sample.attachment
    if attachment is None:
        return records.decode_header(None)
    return records.decode_header(bytes_of(attachment, records.MAX_HEADER_BYTES))


class ReceivedSample(NamedTuple):
    """A sample and when it arrived, on the monotonic clock.

    Args:
        sample: as Zenoh gave it.
        mono_ns: when.
        nth: how many had arrived in its slot by then, itself included; 0 where nobody counts.
    """

    sample: zenoh.Sample
    mono_ns: int
    nth: int = 0


class RejectedSample(NamedTuple):
    """Samples that a slot did not take.

    Args:
        reason: short stable name.
        key: of the newest.
        why: a sentence on it.
        times: how many.
    """

    reason: str
    key: str
    why: str
    times: int


class SampleBuffer:
    """What all have: a bound.

    Args:
        limit: bytes of payload and attachment together.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._refused: dict[str, RejectedSample] = {}

    def _takes(self, sample: zenoh.Sample) -> bool:
        try:
            check_size(sample, self._limit)
        except CodecError as error:
            refused = self._refused
            known = refused.get(error.reason)
            times = known.times + 1 if known else 1
            refused[error.reason] = RejectedSample(
                error.reason, str(sample.key_expr), str(error), times
            )
            return False
        return True

    def pop_rejected(self) -> list[RejectedSample]:
        """What was not taken since the last call, by reason."""
        if not self._refused:
            return []
        found, self._refused = self._refused, {}
        return list(found.values())


class LatestSample(SampleBuffer):
    """Keeps the newest sample, and can be waited on.

    Args:
        limit: bytes of payload and attachment together.
        changed: is notified at every sample; several may share one, to be waited on together.
    """

    def __init__(
        self, limit: int = MAX_RECORD_BYTES, changed: threading.Condition | None = None
    ) -> None:
        super().__init__(limit)
        self._changed = changed or threading.Condition()
        self._arrival: ReceivedSample | None = None
        self._count = 0
        self._taken = 0

    def __call__(self, sample: zenoh.Sample) -> None:
        if not self._takes(sample):
            return
        with self._changed:
            self._count += 1
            self._arrival = ReceivedSample(sample, time.monotonic_ns(), self._count)
            self._changed.notify_all()

    @property
    def count(self) -> int:
        """Samples that ever arrived."""
        return self._count

    @property
    def has_new(self) -> bool:
        """Whether something untaken is there."""
        return self._taken != self._count

    def pop(self) -> ReceivedSample | None:
        """The newest sample, once."""
        with self._changed:
            if self._taken == self._count:
                return None
            self._taken = self._count
            return self._arrival

    def wait(self, timeout_s: float) -> bool:
        """Whether something untaken is there, waiting for it at most so long."""
        with self._changed:
            return self._changed.wait_for(lambda: self._taken != self._count, timeout_s)


class CallbackRing(SampleBuffer):
    """Keeps the newest `size` samples in order; older ones are dropped and counted."""

    def __init__(self, size: int, limit: int = MAX_RECORD_BYTES) -> None:
        super().__init__(limit)
        self._arrivals: deque[ReceivedSample] = deque(maxlen=size)
        self._size = size
        self._count = 0
        self.dropped = 0

    def __call__(self, sample: zenoh.Sample) -> None:
        if not self._takes(sample):
            return
        self._count += 1
        if len(self._arrivals) == self._size:
            self.dropped += 1
        self._arrivals.append(ReceivedSample(sample, time.monotonic_ns(), self._count))

    def drain(self) -> list[ReceivedSample]:
        """Everything that arrived, oldest first."""
        taken: list[ReceivedSample] = []
        while True:
            try:
                taken.append(self._arrivals.popleft())
            except IndexError:
                return taken


class ZenohRing(SampleBuffer):
    """Like `CallbackRing`, filled by Zenoh itself without a word of Python for each sample.

    A flood of samples that nobody asked for then takes no time from the loop that reads them. The
    price: the time of arrival is that of `take_all`, and what is too large is dropped only there.
    """

    def __init__(self, size: int, limit: int = MAX_RECORD_BYTES) -> None:
        super().__init__(limit)
        self._size = size
        self._receive: Callable[[], zenoh.Sample | None] = lambda: None

    def channel(self) -> zenoh.handlers.RingChannel[zenoh.Sample]:
        """The handler to declare a subscriber with."""
        return zenoh.handlers.RingChannel(self._size)

    def receive_from(self, receive: Callable[[], zenoh.Sample | None]) -> None:
        """Where the subscriber's samples are had, one at a time, None when there is none."""
        self._receive = receive

    def drain(self) -> list[ReceivedSample]:
        """Everything that arrived, oldest first; no more than it holds, however fast they come."""
        taken: list[ReceivedSample] = []
        for _ in range(self._size):
            sample = self._receive()
            if sample is None:
                break
            if self._takes(sample):
                taken.append(ReceivedSample(sample, time.monotonic_ns()))
        return taken
