"""Offset of another host's clock from the four stamps of NTP. Pure.

One exchange gives the offset up to half its round trip (RFC 5905, section 8): the delays there and
back cannot be told apart. So of the last exchanges the quickest counts, and half its round trip is
the uncertainty: a bound, not a guess.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TypeVar

from vla_zenoh.types import ActionChunk, Header

WINDOW = 8
"""Exchanges from which the quickest is taken, as in NTP's clock filter."""
DRIFT = 50e-6
"""Two clocks of ordinary computers run apart by this much, s per s."""
LAST_NS = 2**63 - 1
"""The greatest stamp that a record takes."""
_STAMPS_OF_A_CHUNK = (
    "observation_stamp_ns",
    "valid_until_ns",
    "observed_ns",
    "inference_start_ns",
    "inference_end_ns",
)

Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Exchange:
    """One query and its reply, in ns.

    Args:
        asked: time of the query, on our monotonic clock.
        heard: time at which the peer received it, on its wall clock.
        said: time of its reply, on its wall clock.
        got: arrival of the reply, on our monotonic clock.
    """

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


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The peer's wall clock minus ours.

    Args:
        offset_s: positive: the peer's clock is ahead.
        uncertainty_s: the truth is not further away than this.
        round_trip_s: of the newest exchange.
    """

    offset_s: float
    uncertainty_s: float
    round_trip_s: float

    def exceeds(self, bound_s: float) -> bool:
        """Whether the clock is off by more than is compensated, by the estimate alone.

        However long a link is, that is near zero if the clocks agree and both directions take the
        same time. It is off by half of their difference.
        """
        return abs(self.offset_s) > bound_s


class ClockOffsetFilter:
    """Combines exchanges into one offset, and a steady one to convert stamps with.

    A clock that is off by more than `bound_s` is wrong, and its stamps are not converted.
    """

    def __init__(self, bound_s: float) -> None:
        self._bound_s = bound_s
        self._window: deque[Exchange] = deque(maxlen=WINDOW)
        self._best: Exchange | None = None
        self._applied_ns = 0
        self._applied_for: tuple[Exchange, int] | None = None

    def add(self, exchange: Exchange) -> bool:
        """Add an exchange; False: it is impossible, and ignored."""
        if exchange.round_trip_ns < 0 or exchange.said < exchange.heard:
            return False
        if self._best is not None and self._differ(self._best, exchange):
            self._window.clear()  # one of the clocks was set
        self._window.append(exchange)
        self._best = min(self._window, key=lambda one: self._uncertainty_ns(one, exchange.got))
        return True

    def offset(self, wall_minus_mono_ns: int, now_mono_ns: int) -> ClockOffset | None:
        """The offset at a time of our monotonic clock; None before the first exchange."""
        best = self._best
        if best is None:
            return None
        return ClockOffset(
            (best.ahead_ns - wall_minus_mono_ns) / 1e9,
            self._uncertainty_ns(best, now_mono_ns) / 1e9,
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
        # Only these make a difference: with its age an exchange only gets less certain.
        if self._applied_for == (best, wall_minus_mono_ns):
            return self._applied_ns
        self._applied_for = best, wall_minus_mono_ns
        offset_ns = best.ahead_ns - wall_minus_mono_ns
        if abs(offset_ns / 1e9) > self._bound_s:
            self._applied_ns = 0
        elif abs(offset_ns - self._applied_ns) > self._uncertainty_ns(best, now_mono_ns):
            self._applied_ns = offset_ns
        return self._applied_ns

    @staticmethod
    def _uncertainty_ns(exchange: Exchange, now_mono_ns: int) -> int:
        age_ns = max(now_mono_ns - exchange.got, 0)
        return exchange.round_trip_ns // 2 + int(age_ns * DRIFT) + 1

    def _differ(self, one: Exchange, other: Exchange) -> bool:
        apart_ns = abs(one.ahead_ns - other.ahead_ns)
        return apart_ns > self._uncertainty_ns(one, other.got) + other.round_trip_ns // 2 + 1


def shift_stamps(header: Header, record: Record, ahead_ns: int) -> tuple[Header, Record]:
    """Header and record with their stamps on our clock.

    A stamp at an end of what a record takes ("at once", "for ever") stays within it: whether that
    is stale or never expires is for the receiver to decide.

    Args:
        header: of the record.
        record: any; a chunk has stamps of its own.
        ahead_ns: the writer's clock minus ours.
    """

    def here(stamp_ns: int) -> int:
        return min(max(stamp_ns - ahead_ns, 0), LAST_NS)

    header = replace(header, stamp_wall_ns=here(header.stamp_wall_ns))
    if isinstance(record, ActionChunk):
        stamps = {name: here(getattr(record, name)) for name in _STAMPS_OF_A_CHUNK}
        record = replace(record, **stamps)
    return header, record
