"""A wall clock that does not jump, and the loop that keeps time by it."""

from __future__ import annotations

import time
from typing import NamedTuple

ADOPT_S = 0.005
"""A smaller difference to the system's wall clock is slewing, and is followed silently."""
NOISE_S = 0.001
"""A still smaller one is mostly the time between reading two clocks: following it is jitter."""


class Clock:
    """Wall time made of the monotonic clock and an offset taken now and then."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def wall_ns(self) -> int:
        """Nanoseconds since the Unix epoch."""
        return time.monotonic_ns() + self._offset_ns

    @property
    def offset_ns(self) -> int:
        """Wall time minus time of the monotonic clock."""
        return self._offset_ns

    def wall_at(self, mono_ns: int) -> int:
        """The same for a time of the monotonic clock."""
        return mono_ns + self._offset_ns

    def adopt_system_time(self) -> float:
        """Take over the system's wall clock; returns by how much it had been stepped (s), or 0."""
        offset_ns = time.time_ns() - time.monotonic_ns()
        step_s = (offset_ns - self._offset_ns) / 1e9
        if abs(step_s) < NOISE_S:
            return 0.0
        self._offset_ns = offset_ns
        return step_s if abs(step_s) > ADOPT_S else 0.0


class Tick(NamedTuple):
    """One turn of a fixed-rate loop.

    Args:
        periods: how many periods have passed since the last turn, at least 1.
        nominal_ns: the multiple this turn stands for, on the monotonic clock.
        stall_s: how late this turn was woken in all, and how long the computer was suspended.
        computed_s: processor time the turn before took of this thread. Where that is little and the
            stall is long, the computer was busy with something else.
    """

    periods: int
    nominal_ns: int
    stall_s: float
    computed_s: float


def suspended_ns() -> int:
    """How long this computer was suspended since it was booted; 0 where the system does not say.

    Never more than that, whatever is done to this thread between the two clocks.
    """
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return 0 if clock is None else time.clock_gettime_ns(clock) - time.monotonic_ns()


class FixedRate:
    """Wakes at multiples of a period; a missed one is reported, not made up for.

    Periods are those of the monotonic clock, which stands still while the computer is suspended:
    nothing was missed then, but whoever goes on has to know of it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._suspended_ns = max(suspended_ns() for _ in range(3))
        self._period_ns = round(1e9 / rate_hz)
        self._next_ns = time.monotonic_ns() + self._period_ns
        self._computed_ns = time.thread_time_ns()

    def wait(self) -> Tick:
        """Sleep until the next multiple."""
        computed_ns = time.thread_time_ns()
        computed_s = (computed_ns - self._computed_ns) / 1e9
        self._computed_ns = computed_ns
        now_ns = time.monotonic_ns()
        if now_ns < self._next_ns:
            time.sleep((self._next_ns - now_ns) / 1e9)
            now_ns = time.monotonic_ns()
        late_ns = max(now_ns - self._next_ns, 0)
        asleep_ns = max(suspended_ns() - self._suspended_ns, 0)
        self._suspended_ns += asleep_ns
        periods = 1 + late_ns // self._period_ns
        self._next_ns += periods * self._period_ns
        stall_s = (late_ns + asleep_ns) / 1e9
        return Tick(int(periods), self._next_ns - self._period_ns, stall_s, computed_s)
