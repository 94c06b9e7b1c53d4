"""Where Zenoh's callbacks leave samples. A callback does this and nothing else.

An unbounded queue or a slow callback on a stream makes everything behind it late, control keys
included, so streams keep the newest sample only and orders a bounded number.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import zenoh


class Arrival(NamedTuple):
    """A sample and when it arrived, on the monotonic clock.

    Args:
        sample: as Zenoh gave it.
        mono_ns: when.
        nth: how many had arrived in its slot by then, itself included; 0 where nobody counts.
    """

    sample: zenoh.Sample
    mono_ns: int
    nth: int = 0


class Latest:
    """Keeps the newest sample, and can be waited on."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._arrival: Arrival | None = None
        self._count = 0
        self._taken = 0

    def __call__(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self._count += 1
            self._arrival = Arrival(sample, time.monotonic_ns(), self._count)
            self._changed.notify_all()

    @property
    def count(self) -> int:
        """Samples that ever arrived."""
        return self._count

    def take(self) -> Arrival | None:
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


class Inbox:
    """Keeps the newest `size` samples in order; older ones are dropped and counted."""

    def __init__(self, size: int) -> None:
        self._arrivals: deque[Arrival] = deque(maxlen=size)
        self._size = size
        self._count = 0
        self.dropped = 0

    def __call__(self, sample: zenoh.Sample) -> None:
        self._count += 1
        if len(self._arrivals) == self._size:
            self.dropped += 1
        self._arrivals.append(Arrival(sample, time.monotonic_ns(), self._count))

    def take_all(self) -> list[Arrival]:
        """Everything that arrived, oldest first."""
        taken: list[Arrival] = []
        while True:
            try:
                taken.append(self._arrivals.popleft())
            except IndexError:
                return taken


class Mailbox:
    """Like `Inbox`, filled by Zenoh itself without a word of Python for each sample.

    A flood of samples that nobody asked for then takes no time from the loop that reads them. The
    price: the time of arrival is that of `take_all`.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._receive: Callable[[], zenoh.Sample | None] = lambda: None

    def channel(self) -> zenoh.handlers.RingChannel[zenoh.Sample]:
        """The handler to declare a subscriber with."""
        return zenoh.handlers.RingChannel(self._size)

    def take_from(self, receive: Callable[[], zenoh.Sample | None]) -> None:
        """Where the subscriber's samples are had, one at a time, None when there is none."""
        self._receive = receive

    def take_all(self) -> list[Arrival]:
        """Everything that arrived, oldest first; no more than it holds, however fast they come."""
        taken: list[Arrival] = []
        while len(taken) < self._size and (sample := self._receive()) is not None:
            taken.append(Arrival(sample, time.monotonic_ns()))
        return taken
