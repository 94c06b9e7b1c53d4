"""A wall clock that does not jump, and the loop that keeps time by it."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

ADOPT_S = 0.005
"""A smaller difference to the system's wall clock is slewing, and is followed silently."""
NOISE_S = 0.001
"""A still smaller one is mostly the time between reading two clocks: following it is jitter."""
REALTIME_PRIORITY = 40
NICENESS = -10
SET_TIMER_SLACK, GET_TIMER_SLACK = 29, 30  # PR_SET_TIMERSLACK and PR_GET_TIMERSLACK of prctl(2)


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

    def follow(self) -> float:
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
        stall_s: how late this turn was woken in all.
        computed_s: processor time the turn before took of this thread. Where that is little and the
            stall is long, the computer was busy with something else.
    """

    periods: int
    nominal_ns: int
    stall_s: float
    computed_s: float


class FixedRate:
    """Wakes at multiples of a period; a missed one is reported, not made up for."""

    def __init__(self, rate_hz: float) -> None:
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
        periods = 1 + late_ns // self._period_ns
        self._next_ns += periods * self._period_ns
        return Tick(int(periods), self._next_ns - self._period_ns, late_ns / 1e9, computed_s)


def prefer_this_process() -> bool:
    """Ask that the threads started from now on go before those of other programs; False: refused.

    The loop itself asks for more (`realtime_thread`), but it shares an interpreter with
    the threads Zenoh calls back on: one of them that is put aside while it holds the interpreter
    holds up the loop as well.
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    except (OSError, AttributeError):
        return False
    return True


@contextmanager
def realtime_thread() -> Iterator[bool]:
    """Ask for SCHED_FIFO for the calling thread while it is in here; False where not allowed.

    What it starts meanwhile, threads and programs alike, does not inherit that: a tool that starts
    up with the priority of a control loop would hold every loop of the computer up.
    """
    slack_ns = _timer_slack(1)
    policy, priority = _scheduling()
    try:
        os.sched_setscheduler(
            0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY)
        )
        granted = True
    except (OSError, AttributeError):
        granted = False
    try:
        yield granted
    finally:
        if granted:
            _schedule(policy, priority)
        _timer_slack(slack_ns)


def _schedule(policy: int, priority: int) -> None:
    """As it was before; whoever is not privileged cannot take back what is not inherited."""
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except PermissionError:
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _scheduling() -> tuple[int, int]:
    """Policy and priority of the calling thread; zeros where a system has no such thing."""
    try:
        return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    except (OSError, AttributeError):
        return 0, 0


def _timer_slack(slack_ns: int) -> int:
    """Set by how much the calling thread may be woken late; returns what was set before."""
    library = ctypes.util.find_library("c")
    if library is None:
        return 0
    control = ctypes.CDLL(library, use_errno=True).prctl
    before_ns = int(control(GET_TIMER_SLACK, 0, 0, 0, 0))
    control(SET_TIMER_SLACK, max(slack_ns, 0), 0, 0, 0)
    return before_ns
