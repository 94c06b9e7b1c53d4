"""Wall clock that does not jump, a timer for fixed-rate loops, and the host whose clock it is."""

from __future__ import annotations

import os
import socket
import threading
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_zenoh.keys import key_chunk

if TYPE_CHECKING:
    from vla_zenoh.profile import SessionProfile

ADOPT_S = 0.005
"""A smaller difference to the system's wall clock is slewing, and is followed silently."""
NOISE_S = 0.001
"""A still smaller one is mostly the time between reading two clocks; following it would jitter."""


class Clock:
    """Wall clock: the monotonic clock plus an offset that is updated now and then."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def wall_ns(self) -> int:
        """Nanoseconds since the Unix epoch."""
        return time.monotonic_ns() + self._offset_ns

    @property
    def offset_ns(self) -> int:
        """Wall time minus monotonic time."""
        return self._offset_ns

    def wall_at(self, mono_ns: int) -> int:
        """Wall time of a monotonic time."""
        return mono_ns + self._offset_ns

    def adopt_system_time(self) -> float:
        """Adopt the system's wall clock; returns its step in s, 0 if there was none."""
        offset_ns = time.time_ns() - time.monotonic_ns()
        step_s = (offset_ns - self._offset_ns) / 1e9
        if abs(step_s) < NOISE_S:
            return 0.0
        self._offset_ns = offset_ns
        return step_s if abs(step_s) > ADOPT_S else 0.0


class Tick(NamedTuple):
    """One cycle of a fixed-rate loop.

    Args:
        periods: since the last cycle, at least 1.
        nominal_ns: nominal time of this cycle, monotonic clock.
        stall_s: how late it begins, plus how long the computer was suspended.
        computed_s: processor time of this thread in the last cycle. If that is short and the stall
            long, the computer was busy with something else.
    """

    periods: int
    nominal_ns: int
    stall_s: float
    computed_s: float


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
        """Wait for `arrival`, at most until the next cycle; returns whether it came; clears it."""
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


HOST_VARIABLE = "VLA_ZENOH_HOST"
"""Name of this host in the profile, unless an option gives it."""
BOOT_FILE = Path("/proc/sys/kernel/random/boot_id")


class HostId(NamedTuple):
    """Host on which a node runs.

    Args:
        host: name in the profile if known, else the computer's own name, which need not be unique.
        boot: unique id of this boot; empty if the system has none.
    """

    host: str
    boot: str

    def shares_clock(self, other: HostId) -> bool:
        """Whether both certainly run on the same computer; False if unknown."""
        return bool(self.boot) and self == other


def own_host_id(session: SessionProfile, host: str | None = None) -> HostId:
    """Identity of this host; `host` is given by an option, a secured one named by its certificates.

    Raises:
        ProfileError: the name cannot be part of a key.
    """
    security = session.security
    named = host or (security.host if security else None) or os.environ.get(HOST_VARIABLE)
    if not named and security is not None:
        from vla_zenoh.security.store import Store

        named = Store(security.folder).known_host()
    return HostId(key_chunk(named, "host") if named else socket.gethostname(), own_boot_id())


@cache
def own_boot_id() -> str:
    """Id of this boot; empty if the system has none."""
    try:
        return BOOT_FILE.read_text("ascii").strip()
    except OSError:
        return ""
