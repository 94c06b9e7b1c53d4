"""Compares what a reader receives on each key with what the senders' statuses say they sent.

A transport may drop samples without an error at either end (a full queue, shared memory that cannot
be mapped, access control). The status of every node says how many records it has published on each
key, see `Traffic.sent`; a reader counts those that arrive.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.session import covers
from vla_zenoh.keys import Keys
from vla_zenoh.types import NodeStatus

SHARE, WINDOW_S = 0.8, 2.0
"""A stream is short if less than this share of what was sent arrives within the window."""
SLACK = 2
"""Samples that may be missing: a status overtakes the images that were sent before it."""
SETTLE_S = 1.0
"""After a subscription: senders learn of it first."""
MAX_STREAMS, MAX_SENDERS = 256, 8
REMEDY = (
    "run `vla-zenoh doctor` on the hosts of both: where too little memory may be locked for shared "
    "memory, a reader that is not ours needs transport/shared_memory/enabled: false. Otherwise the "
    "network or this computer is too slow for it, or access control does not permit it here"
)


class Share(NamedTuple):
    """Samples of a stream that were sent and received, over the same time."""

    sent: int
    received: int

    @property
    def lost(self) -> int:
        """Samples that did not arrive, 0 within `SLACK`."""
        missing = self.sent - self.received
        return missing if missing > SLACK else 0

    def below(self, share: float) -> bool:
        return self.lost > 0 and self.received < share * self.sent


class _Watch(NamedTuple):
    expression: str
    arrived: Mapping[str, int]
    since_s: float


class _Stream:
    """One key, as one subscription receives it."""

    def __init__(self) -> None:
        self.senders: Bounded[tuple[str, int], int] = Bounded(MAX_SENDERS)
        self.sent = self.received = 0
        self.first_received = -1
        self.window: deque[tuple[float, int, int]] = deque()

    def add(self, now_s: float, sender: tuple[str, int], count: int, received: int) -> None:
        before = self.senders.get(sender)
        self.senders[sender] = count
        if self.first_received < 0:  # the comparison begins with the sender's first status
            self.first_received = received
        elif before is not None:
            self.sent += max(count - before, 0)
        self.received = received - self.first_received
        self.window.append((now_s, self.sent, self.received))
        while len(self.window) > 2 and now_s - self.window[1][0] >= WINDOW_S:
            self.window.popleft()

    def lately(self, now_s: float) -> Share | None:
        """Its share within the window; None if that is not full, or the sender fell silent."""
        (first_s, sent, received), (last_s, *_) = self.window[0], self.window[-1]
        if last_s - first_s < WINDOW_S or now_s - last_s > WINDOW_S:
            return None
        return Share(self.sent - sent, self.received - received)


class Reception:
    """What arrives of what is sent, for all subscriptions of a reader. Safe to use from several
    threads."""

    def __init__(self, keys: Keys, clock: Callable[[], float] = time.monotonic) -> None:
        self._keys, self._clock = keys, clock
        self._lock = threading.Lock()
        self._watches: list[_Watch] = []
        self._streams: Bounded[str, _Stream] = Bounded(MAX_STREAMS)

    def watch(self, expression: str, arrived: Mapping[str, int]) -> None:
        """Follow a subscription: `arrived` has the number of samples of each key, and grows."""
        with self._lock:
            self._watches.append(_Watch(expression, arrived, self._clock()))

    def unwatch(self, arrived: Mapping[str, int]) -> None:
        """The subscription has ended."""
        with self._lock:
            ended = [one for one in self._watches if one.arrived is arrived]
            self._watches = [one for one in self._watches if one.arrived is not arrived]
            for key in list(self._streams):
                if any(covers(one.expression, key) for one in ended):
                    del self._streams[key]

    def status_received(self, status: NodeStatus) -> None:
        """Compare with the counts in the status of a sender."""
        net = status.detail.get("net")
        sent = net.get("sent") if isinstance(net, Mapping) else None
        for short, row in sent.items() if isinstance(sent, Mapping) else ():
            if isinstance(row, (list, tuple)) and len(row) == 3 and isinstance(row[2], int):
                self._sent(short, (status.node, status.started_wall_ns), row[2])

    def _sent(self, short: str, sender: tuple[str, int], count: int) -> None:
        key, now_s = self._keys.full(short), self._clock()
        with self._lock:
            watch = next((one for one in self._watches if covers(one.expression, key)), None)
            if watch is None or now_s - watch.since_s < SETTLE_S:
                return
            stream = self._streams[key] = self._streams.get(key) or _Stream()
            stream.add(now_s, sender, count, watch.arrived.get(key, 0))

    def short(self) -> dict[str, str]:
        """Key without root and robot -> sentence, of the streams of which too little arrived
        lately."""
        now_s, found = self._clock(), dict[str, str]()
        with self._lock:
            for key, stream in self._streams.items():
                share = stream.lately(now_s)
                if share is not None and share.below(SHARE):
                    name = self._keys.short(key)
                    found[name] = (
                        f"{name}: {share.received} of {share.sent} samples arrived in "
                        f"{WINDOW_S:g} s; {REMEDY}"
                    )
        return found

    def shares(self) -> dict[str, Share]:
        """Key -> its share since the subscription, of those whose sender's status says how many
        there were."""
        with self._lock:
            found = {key: Share(one.sent, one.received) for key, one in self._streams.items()}
        return {key: share for key, share in found.items() if share.sent}


def lost_in_words(lost: Mapping[str, int], keys: Keys, most: int = 5) -> str:
    """The keys that lost most, with their numbers."""
    worst = Counter(dict(lost)).most_common(most)
    more = f", and {len(lost) - most} more keys" if len(lost) > most else ""
    return ", ".join(f"{keys.short(key)} {count}" for key, count in worst) + more
