"""Scheduling priorities on a busy computer: loops that keep an arm in motion, then their links."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

LOOP_PRIORITY, LINK_PRIORITY = 40, 30
"""SCHED_FIFO priorities: no link thread may preempt a control loop."""
INNER_PRIORITY = 45
"""Of a robot's own loop inside a driver library, which is faster than ours."""
TASKS = Path("/proc/self/task")
"""Threads of this process; empty where this is not Linux."""
NICENESS = -10
SET_TIMER_SLACK, GET_TIMER_SLACK = 29, 30  # PR_SET_TIMERSLACK and PR_GET_TIMERSLACK of prctl(2)


def prctl(option: int, value: int = 0) -> int:
    """Call prctl(2) of Linux; 0 on other systems."""
    if sys.platform != "linux":
        return 0
    return int(ctypes.CDLL(None).prctl(option, ctypes.c_ulong(value), 0, 0, 0))


def prefer_this_process() -> None:
    """Let threads started from now on run before those of other programs, where permitted.

    For threads without a real-time priority, and for systems that grant none.
    """
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def realtime_links() -> AbstractContextManager[bool]:
    """Threads started in this context get SCHED_FIFO: those of a Zenoh session opened here.

    A state or command that waits in such a thread is as late as if the loop had waited; and one
    that is preempted while it holds the GIL blocks the loop as well. False: not permitted.
    """
    return _scheduled(LINK_PRIORITY, inherited=True)


@contextmanager
def realtime_thread() -> Iterator[bool]:
    """SCHED_FIFO for the calling thread in this context; yields False if not permitted.

    Threads and programs started meanwhile do not inherit it: a tool that starts with the priority
    of a control loop would block every loop of the computer.
    """
    slack_ns = prctl(GET_TIMER_SLACK)
    prctl(SET_TIMER_SLACK, 1)
    try:
        with _scheduled(LOOP_PRIORITY, inherited=False) as granted:
            yield granted
    finally:
        prctl(SET_TIMER_SLACK, slack_ns)


@contextmanager
def realtime_children() -> Iterator[None]:
    """SCHED_FIFO for the threads that a library starts in this context.

    They inherit nothing from a `realtime_thread`.
    """
    before = set(TASKS.glob("*"))
    yield
    for task in set(TASKS.glob("*")) - before:
        try:
            os.sched_setscheduler(int(task.name), os.SCHED_FIFO, os.sched_param(INNER_PRIORITY))
        except OSError:  # not permitted, or already over
            return


@contextmanager
def _scheduled(priority: int, *, inherited: bool) -> Iterator[bool]:
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        flag = 0 if inherited else os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, os.SCHED_FIFO | flag, os.sched_param(priority))
    except (OSError, AttributeError):  # not permitted, or not Linux
        yield False
        return
    try:
        yield True
    finally:
        policy, parameter = before
        try:
            os.sched_setscheduler(0, policy, parameter)
        except PermissionError:  # without privilege it can only come back as not inherited
            os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameter)
