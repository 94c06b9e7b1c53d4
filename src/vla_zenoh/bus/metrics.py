"""Rates, latencies and traffic of a node for its status, and the throttle of its events."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus import shared_memory
from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.session import covers
from vla_zenoh.types import Event, Header


class RateMeter:
    """Rate of events over a sliding window."""

    def __init__(self, window_s: float = 2.0) -> None:
        self._window_s = window_s
        self._times: deque[float] = deque(maxlen=4096)

    def tick(self) -> None:
        """Count one event."""
        self._times.append(time.monotonic())

    @property
    def rate_hz(self) -> float:
        """Events per second, 0 if none happened within the window."""
        now = time.monotonic()
        while self._times and now - self._times[0] > self._window_s:
            self._times.popleft()
        if len(self._times) < 2:
            return 0.0
        span_s = self._times[-1] - self._times[0]
        mean_s = span_s / (len(self._times) - 1)
        # The rate falls only once the next event is overdue.
        overdue_s = max(now - self._times[-1] - 1.5 * mean_s, 0.0)
        return (len(self._times) - 1) / max(span_s + overdue_s, 1e-6)


SHARES = (("p50", 0.5), ("p95", 0.95), ("p99", 0.99), ("max", 1.0))


class Percentiles:
    """Percentiles of the last values."""

    def __init__(self, size: int) -> None:
        self._values = np.empty(size)
        self._count = 0

    def add(self, value: float) -> None:
        """Add a value."""
        self._values[self._count % len(self._values)] = value
        self._count += 1

    def summary(self) -> tuple[float, float] | None:
        """(p50, p95), None without values."""
        found = self._shares()
        return (found["p50"], found["p95"]) if found else None

    def spread(self) -> dict[str, float]:
        """p50, p95, p99 and max; empty without values."""
        return {name: round(value, 1) for name, value in self._shares().items()}

    def _shares(self) -> dict[str, float]:
        ordered = np.sort(self._values[: self._count])
        last = len(ordered) - 1
        return {name: float(ordered[round(at * last)]) for name, at in SHARES if last >= 0}


LINKS_PERIOD_S = 5.0
MAX_SENDERS = 256
"""Sources whose losses are counted; beyond that the one silent for longest is forgotten."""
OTHERS = "others"
"""Stands for all keys beyond `MAX_SENDERS` in the count of losses."""
MAX_LINKS = 8


class Traffic:
    """Rates of published records from one status to the next, records that were lost, and links."""

    def __init__(self, session: zenoh.Session) -> None:
        self.sessions = [session]
        """Whose links are listed."""
        self._reported_s = time.monotonic()
        self._sent: dict[str, tuple[int, int]] = {}
        # (key, source) -> its first seq, our count then, losses since
        self._received: Bounded[tuple[str, str], tuple[int, int, int]] = Bounded(MAX_SENDERS)
        self.lost: Counter[str] = Counter()
        """Key -> records that never arrived here."""
        self._links: list[str] = []
        self._memory: dict[str, Any] = {}
        self._looked_s = -1e9

    def received(self, key: str, header: Header, arrivals: int) -> None:
        """Count a received record, when `arrivals` of its key had arrived; 0: unknown.

        Records that a buffer dropped are not lost: they arrived. If several sources share a key too
        few are counted, never too many.
        """
        who = (key, header.source)
        if arrivals == 0:
            self._received.pop(who, None)
            return
        seq, count, before = self._received.get(who, (header.seq, arrivals, 0))
        lost = max((header.seq - seq) - (arrivals - count), before)
        self._received[who] = (seq, count, lost)
        if lost > before:
            full = key not in self.lost and len(self.lost) >= MAX_SENDERS
            self.lost[OTHERS if full else key] += lost - before

    def forget(self, expression: str) -> None:
        """A subscription has ended: what is published until the next one is not lost."""
        for who in [who for who in self._received if covers(expression, who[0])]:
            del self._received[who]

    def sent(self, streams: Iterable[Any]) -> dict[str, list[float | int]]:
        """Key -> records and bytes per second of these `Publisher`, since the last call, and
        records since the beginning."""
        now_s = time.monotonic()
        took_s = max(now_s - self._reported_s, 1e-3)
        self._reported_s = now_s
        out: dict[str, list[float | int]] = {}
        before, self._sent = self._sent, {}
        for stream in streams:
            count, size = before.get(stream.key, (0, 0))
            self._sent[stream.key] = (stream.seq, stream.sent_bytes)
            if stream.seq > count:
                rates = ((stream.seq - count) / took_s, (stream.sent_bytes - size) / took_s)
                out[stream.key] = [*(round(rate, 2) for rate in rates), stream.seq]
        return out

    def links(self) -> list[str]:
        """Endpoints this node is connected to, as Zenoh writes them."""
        self._look()
        return self._links

    def memory(self) -> dict[str, Any]:
        """Its shared memory, see `shared_memory.figures`."""
        self._look()
        return self._memory

    def _look(self) -> None:
        if time.monotonic() - self._looked_s <= LINKS_PERIOD_S:
            return
        self._looked_s = time.monotonic()
        found = {str(link.dst) for one in self.sessions for link in one.info.links()}
        self._links = sorted(found)[:MAX_LINKS]
        self._memory = shared_memory.figures()


PERIOD_S = 0.25
"""An event of one kind is published at most this often; `count` says how many it stands for."""
LONGEST_S = 5.0
"""A sender who mends one mistake and makes another of its kind is told of it by then."""
ANSWER = "_refused"
"""End of the names of rejected settings, whose sender waits for the reasons."""

Kind = tuple[str, str, str]


class EventThrottle:
    """Decides when an event is published.

    Transitions always are. Everything else is published at once or, while one of its kind has just
    been, late: nothing is left out, because a client may wait for the answer. Between two events of
    a kind are `PERIOD_S`. Rejections of samples may go on for hours, as while another version of
    the wire writes: their periods double, up to `LONGEST_S`, until there was none for a period.
    A kind is remembered for that long, so memory is bounded by how many the node can receive in
    `PERIOD_S`, and no client can make it forget what it owes to another.
    """

    def __init__(
        self, publish: Callable[[Event], Any], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._publish, self._clock = publish, clock
        self._next_s: dict[Kind, float] = {}
        self._period_s: dict[Kind, float] = {}
        self._owed: dict[Kind, Event] = {}
        """Newest event of a kind that waits, with the count of all that do."""

    def emit(self, event: Event, about: str = "") -> None:
        """Publish an event, or keep it for `poll`; each `about` is throttled by itself."""
        if event.what.endswith(ANSWER):  # every reason against a setting, not only the first
            about = event.why
        kind = (event.kind, event.what, about)
        waiting = self._owed.get(kind)
        if waiting is not None:
            event = replace(event, count=event.count + waiting.count)
        self._owed[kind] = event
        if event.kind == "transition" or self._is_due(kind):
            self._send(kind)

    def poll(self) -> None:
        """Publish what is due."""
        for kind in [kind for kind in self._owed if self._is_due(kind)]:
            self._send(kind)
        for kind in [kind for kind in self._next_s if self._is_due(kind)]:
            del self._next_s[kind], self._period_s[kind]

    def _is_due(self, kind: Kind) -> bool:
        return self._clock() >= self._next_s.get(kind, -math.inf)

    def _send(self, kind: Kind) -> None:
        event = self._owed.pop(kind)
        period_s = PERIOD_S
        if event.kind == "refusal" and not event.what.endswith(ANSWER):
            period_s = min(2.0 * self._period_s.get(kind, PERIOD_S / 2.0), LONGEST_S)
        self._period_s[kind] = period_s
        self._next_s[kind] = self._clock() + period_s
        self._publish(event)
