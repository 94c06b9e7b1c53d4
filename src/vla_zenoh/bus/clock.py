"""Clocks: wall time that does not jump, a timer for fixed-rate loops, and the offsets of other
nodes' clocks, with which their stamps are converted.

A node queries the nodes it knows to be alive, and those whose streams it receives; it never waits
for a reply. A header may name any source, so names known from headers alone have a separate quota.

One exchange of four stamps, as in NTP, gives the offset up to half its round trip (RFC 5905,
section 8): the delays there and back cannot be told apart. So of the last exchanges the quickest
counts, and half its round trip is the uncertainty: a bound, not a guess.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.session import QOS
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.keys import Keys, Kind
from vla_zenoh.types import ClockReply, Header

ADOPT_S = 0.005
"""A smaller difference to the system's wall clock is slewing, and is followed silently."""
NOISE_S, READINGS = 0.001, 3
"""A still smaller one is mostly the time between reading two clocks; following it would jitter. A
thread that is preempted there finds the wall clock too early, so the latest reading counts."""
ASK_PERIOD_S = 1.0
FIRST_ASKS, FIRST_PERIOD_S = 8, 0.1
"""The first queries follow each other quickly: one of them will be undisturbed."""
PATIENCE_S = 2.0
FORGET_S = 30.0
"""An offset is discarded after this time without a reply."""
HEARD_PATIENCE_S = 2.0
"""A name known from headers alone that never replied makes room after this time."""
MAX_PEERS, MAX_HEARD = 64, 32
"""Nodes known to be alive, and names known from headers alone."""
MAX_STAMPS_BYTES = 1024
WINDOW = 8
"""Exchanges from which the quickest is taken, as in NTP's clock filter."""
DRIFT = 50e-6
"""Two clocks of ordinary computers run apart by this much, s per s."""
LAST_NS = 2**63 - 1
"""The greatest stamp that a record takes."""

Record = TypeVar("Record")


class Clock:
    """Wall clock: the monotonic clock plus an offset that is updated now and then."""

    def __init__(self) -> None:
        self.offset_ns = max(time.time_ns() - time.monotonic_ns() for _ in range(READINGS))
        """Wall time minus monotonic time."""

    def wall_ns(self) -> int:
        """Nanoseconds since the Unix epoch."""
        return time.monotonic_ns() + self.offset_ns

    def wall_at(self, mono_ns: int) -> int:
        """Wall time of a monotonic time."""
        return mono_ns + self.offset_ns

    def adopt_system_time(self) -> float:
        """Adopt the system's wall clock; returns its step in s, 0 if there was none."""
        offset_ns = max(time.time_ns() - time.monotonic_ns() for _ in range(READINGS))
        step_s = (offset_ns - self.offset_ns) / 1e9
        if abs(step_s) >= NOISE_S:
            self.offset_ns = offset_ns
        return step_s if abs(step_s) > ADOPT_S else 0.0


class Tick(NamedTuple):
    """One cycle of a fixed-rate loop."""

    periods: int
    """Since the last cycle, at least 1."""
    nominal_ns: int
    """Monotonic clock."""
    stall_s: float
    """How late it begins, plus how long the computer was suspended."""
    computed_s: float
    """Processor time of this thread in the last cycle. If that is short and the stall long, the
    computer was busy with something else."""


def suspended_ns() -> int:
    """How long this computer was suspended since boot; 0 if unknown.

    Never too long, even if this thread is preempted between reading the two clocks.
    """
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return 0 if clock is None else time.clock_gettime_ns(clock) - time.monotonic_ns()


class FixedRate:
    """Timer of a loop that runs at multiples of a period; missed cycles are reported and skipped.

    The monotonic clock stands still while the computer is suspended. No cycle is missed then, but
    the suspension is reported as a stall.
    """

    def __init__(self, rate_hz: float) -> None:
        self._suspended_ns = max(suspended_ns() for _ in range(3))
        self._period_ns = round(1e9 / rate_hz)
        self.next_ns = time.monotonic_ns() + self._period_ns
        """Time of the next cycle, monotonic clock."""
        self._computed_ns = time.thread_time_ns()

    def skip(self, periods: int) -> None:
        """Let the next cycle be the `periods`-th from now; those before are not missed."""
        self.next_ns += (periods - 1) * self._period_ns

    def resume(self) -> None:
        """End a skip: the next cycle is at the next multiple."""
        early = (self.next_ns - time.monotonic_ns()) // self._period_ns
        self.next_ns -= max(early, 0) * self._period_ns

    def wait_for(self, arrival: threading.Event) -> bool:
        """Wait for `arrival`, at most until the next cycle; whether it came.

        It is cleared then.
        """
        left_ns = self.next_ns - time.monotonic_ns()
        if left_ns <= 0 or not arrival.wait(left_ns / 1e9):
            return False
        arrival.clear()
        return True

    def wait_until(self, before_ns: int) -> None:
        """Sleep until `before_ns` before the next cycle."""
        left_ns = self.next_ns - before_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns / 1e9)

    def wait(self) -> Tick:
        """Sleep until the next multiple."""
        before_ns, self._computed_ns = self._computed_ns, time.thread_time_ns()
        computed_s = (self._computed_ns - before_ns) / 1e9
        now_ns = time.monotonic_ns()
        if now_ns < self.next_ns:
            time.sleep((self.next_ns - now_ns) / 1e9)
            now_ns = time.monotonic_ns()
        late_ns = max(now_ns - self.next_ns, 0)
        asleep_ns = max(suspended_ns() - self._suspended_ns, 0)
        self._suspended_ns += asleep_ns
        periods = 1 + late_ns // self._period_ns
        self.next_ns += periods * self._period_ns
        stall_s = (late_ns + asleep_ns) / 1e9
        return Tick(int(periods), self.next_ns - self._period_ns, stall_s, computed_s)


class Exchange(NamedTuple):
    """One query and its reply, ns: `asked` and `got` on our monotonic clock, `heard` and `said` on
    the peer's wall clock."""

    asked: int
    heard: int
    said: int
    got: int

    @property
    def round_trip_ns(self) -> int:
        """Round trip without the time the peer took to reply."""
        return (self.got - self.asked) - (self.said - self.heard)

    @property
    def ahead_ns(self) -> int:
        """The peer's wall clock minus our monotonic clock."""
        return ((self.heard - self.asked) + (self.said - self.got)) // 2

    def uncertainty_ns(self, now_mono_ns: int) -> int:
        """Half of the round trip, and the drift since then."""
        age_ns = max(now_mono_ns - self.got, 0)
        return self.round_trip_ns // 2 + int(age_ns * DRIFT) + 1


class ClockOffset(NamedTuple):
    """The peer's wall clock minus ours: the truth is within `uncertainty_s` of `offset_s`.

    `round_trip_s`: of the newest exchange.
    """

    offset_s: float
    uncertainty_s: float
    round_trip_s: float


class ClockOffsetFilter:
    """Combines exchanges into one offset, and a steady one to convert stamps with.

    A clock that is off by more than `bound_s` is wrong; its stamps are not converted.
    """

    def __init__(self, bound_s: float) -> None:
        self._bound_s = bound_s
        self._window: deque[Exchange] = deque(maxlen=WINDOW)
        self._best: Exchange | None = None
        self._applied_ns = 0

    def add(self, exchange: Exchange) -> bool:
        """Add an exchange; False: it is impossible, and ignored."""
        if exchange.round_trip_ns < 0 or exchange.said < exchange.heard:
            return False
        if (best := self._best) is not None:
            doubt_ns = best.uncertainty_ns(exchange.got) + exchange.uncertainty_ns(exchange.got)
            if abs(best.ahead_ns - exchange.ahead_ns) > doubt_ns:
                self._window.clear()  # one of the clocks was set
        self._window.append(exchange)
        self._best = min(self._window, key=lambda one: one.uncertainty_ns(exchange.got))
        return True

    def offset(self, wall_minus_mono_ns: int, now_mono_ns: int) -> ClockOffset | None:
        """The offset at a time of our monotonic clock; None before the first exchange."""
        best = self._best
        if best is None:
            return None
        return ClockOffset(
            (best.ahead_ns - wall_minus_mono_ns) / 1e9,
            best.uncertainty_ns(now_mono_ns) / 1e9,
            self._window[-1].round_trip_ns / 1e9,
        )

    def applied_ns(self, wall_minus_mono_ns: int, now_mono_ns: int) -> int:
        """Offset to subtract from the peer's stamps to convert them to our clock.

        It changes only when it is certainly wrong, so that stamps do not jitter with every
        exchange; it is zero for a clock beyond the bound.
        """
        best = self._best
        if best is None:
            return 0
        offset_ns = best.ahead_ns - wall_minus_mono_ns
        bound_ns, doubt_ns = self._bound_s * 1e9, best.uncertainty_ns(now_mono_ns)
        if abs(offset_ns) > max(bound_ns, doubt_ns):
            self._applied_ns = 0
        elif abs(offset_ns - self._applied_ns) > doubt_ns:
            self._applied_ns = offset_ns if abs(offset_ns) <= bound_ns else 0
        return self._applied_ns


def shift_stamps(header: Header, record: Record, ahead_ns: int) -> tuple[Header, Record]:
    """Header and record, of a writer whose clock is `ahead_ns` of ours, with their stamps on ours.

    A stamp at an end of what a record takes ("at once", "for ever") stays within it: whether that
    is stale or never expires is for the receiver to decide.
    """

    from vla_zenoh.types.records import ActionChunk  # brings numpy

    def here(stamp_ns: int) -> int:
        return min(max(stamp_ns - ahead_ns, 0), LAST_NS)

    header = replace(header, stamp_wall_ns=here(header.stamp_wall_ns))
    if isinstance(record, ActionChunk):
        names = [name for name in ActionChunk.__match_args__ if name.endswith("_ns")]
        stamps = {name: here(getattr(record, name)) for name in names}
        record = replace(record, **stamps)
    return header, record


@dataclass(slots=True)
class _Peer:
    key: str
    filter: ClockOffsetFilter
    since_s: float
    alive: bool
    asks: int = 0
    next_ask_s: float = 0.0
    answered_s: float = -1e9

    def forgotten(self, now_s: float) -> bool:
        """Silent for so long that another peer may take its place."""
        real = self.alive or self.answered_s > 0
        silent_s = now_s - max(self.answered_s, self.since_s)
        return silent_s > (FORGET_S if real else HEARD_PATIENCE_S)


class ClockSync:
    """Clock offsets of the nodes other than `name`, and stamps converted with them, see
    `ClockOffsetFilter`."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        clock: Clock,
        name: str,
        bound_s: float,
    ) -> None:
        self._session, self._keys, self._clock, self._name = session, keys, clock, name
        self._bound_s = bound_s
        self._lock = threading.Lock()
        self._peers: dict[str, _Peer] = {}
        self._next_look_s = 0.0

    def track(self, node: str, *, alive: bool = True) -> None:
        """Measure the clock of `node` from now on; invalid names are ignored."""
        known = self._peers.get(node)
        if known is not None:
            known.alive = known.alive or alive
            return
        others = sum(peer.alive is alive for peer in list(self._peers.values()))
        if node == self._name or others >= (MAX_PEERS if alive else MAX_HEARD):
            return
        try:
            key = self._keys.clock(node)
        except ProfileError:
            return
        with self._lock:
            self._peers[node] = _Peer(
                key, ClockOffsetFilter(self._bound_s), time.monotonic(), alive
            )
        self._next_look_s = 0.0

    def poll(self) -> None:
        """Send the queries that are due. Cheap; call it from the loop of the node."""
        now_s = time.monotonic()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + FIRST_PERIOD_S / 2
        for node, peer in list(self._peers.items()):
            if now_s >= peer.next_ask_s:
                peer.asks += 1
                peer.next_ask_s = now_s + (
                    FIRST_PERIOD_S if peer.asks <= FIRST_ASKS else ASK_PERIOD_S
                )
                self._ask(peer)
            if peer.forgotten(now_s):
                with self._lock:  # room for others; it comes back with its next sample
                    del self._peers[node]

    def _ask(self, peer: _Peer) -> None:
        asked_ns = time.monotonic_ns()

        def on_reply(reply: zenoh.Reply) -> None:
            got_ns = time.monotonic_ns()
            if reply.ok is None:
                return
            try:
                there = records.decode(ClockReply, bytes_of(reply.ok.payload, MAX_STAMPS_BYTES))
            except CodecError:
                return  # not one of our nodes' clocks
            with self._lock:
                if peer.filter.add(Exchange(asked_ns, there.heard_ns, there.said_ns, got_ns)):
                    peer.answered_s = time.monotonic()

        self._session.get(
            peer.key,
            zenoh.handlers.Callback(on_reply, indirect=False),
            timeout=PATIENCE_S,
            **QOS[Kind.CONTROL],
        )

    def reply(self, query: zenoh.Query) -> None:
        """Reply to a query of this node's clock with the times of its arrival and of this reply."""
        reply = ClockReply(self._clock.wall_ns(), self._clock.wall_ns())
        query.reply(self._keys.clock(self._name), records.encode(reply))

    def offsets(self) -> dict[str, ClockOffset]:
        """Node -> its clock minus ours, of those that replied lately."""
        now_ns, now_s = time.monotonic_ns(), time.monotonic()
        with self._lock:
            found = {
                node: peer.filter.offset(self._clock.offset_ns, now_ns)
                for node, peer in self._peers.items()
                if now_s - peer.answered_s < FORGET_S
            }
        return {node: offset for node, offset in found.items() if offset is not None}

    def to_local_clock(self, header: Header, record: Record) -> tuple[Header, Record]:
        """Header and record with their stamps converted to our clock."""
        node = header.source.partition("#")[0]
        peer = self._peers.get(node)
        if peer is None:
            self.track(node, alive=False)
            return header, record
        with self._lock:
            ahead_ns = peer.filter.applied_ns(self._clock.offset_ns, time.monotonic_ns())
        return shift_stamps(header, record, ahead_ns) if ahead_ns else (header, record)
