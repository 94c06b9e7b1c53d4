"""Scheduling priorities on a busy computer: loops that keep an arm in motion, then their links."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

LOOP_PRIORITY, LINK_PRIORITY = 40, 30
"""SCHED_FIFO priorities: no link thread may preempt a control loop."""
INNER_PRIORITY = 45
"""Of a robot's own loop inside a driver library, which is faster than ours."""
TASKS = "/proc/self/task"
NICENESS = -10
SET_TIMER_SLACK, GET_TIMER_SLACK = 29, 30  # PR_SET_TIMERSLACK and PR_GET_TIMERSLACK of prctl(2)


def prefer_this_process() -> bool:
    """Let threads started from now on run before those of other programs; False: not permitted.

    For threads without a real-time priority, and for systems that grant none.
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    except (OSError, AttributeError):
        return False
    return True


@contextmanager
def realtime_links() -> Iterator[bool]:
    """Threads started in this context get SCHED_FIFO: those of a Zenoh session opened here.

    A state or command that waits in such a thread is as late as if the loop had waited; and one
    that is preempted while it holds the GIL blocks the loop as well. Yields False if not permitted.
    """
    with _scheduled(LINK_PRIORITY, inherited=True) as granted:
        yield granted


@contextmanager
def realtime_thread() -> Iterator[bool]:
    """SCHED_FIFO for the calling thread in this context; yields False if not permitted.

    Threads and programs started meanwhile do not inherit it: a tool that starts with the priority
    of a control loop would block every loop of the computer.
    """
    slack_ns = _timer_slack(1)
    try:
        with _scheduled(LOOP_PRIORITY, inherited=False) as granted:
            yield granted
    finally:
        _timer_slack(slack_ns)


@contextmanager
def realtime_children() -> Iterator[None]:
    """SCHED_FIFO for the threads that a library starts in this context.

    They inherit nothing from a `realtime_thread`.
    """
    before = set(_tasks())
    yield
    for task in set(_tasks()) - before:
        try:
            os.sched_setscheduler(task, os.SCHED_FIFO, os.sched_param(INNER_PRIORITY))
        except (OSError, AttributeError):  # not permitted, already over, or not Linux
            return


def _tasks() -> list[int]:
    return [int(name) for name in os.listdir(TASKS)] if os.path.isdir(TASKS) else []


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
        _give_back(*before)


def _give_back(policy: int, parameter: os.sched_param) -> None:
    """Restore the policy; without privilege, one that is not inherited cannot be restored."""
    try:
        os.sched_setscheduler(0, policy, parameter)
    except PermissionError:
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameter)


def _timer_slack(slack_ns: int) -> int:
    """Set the timer slack of the calling thread; returns the previous one."""
    if sys.platform != "linux" or (library := ctypes.util.find_library("c")) is None:
        return 0
    control = ctypes.CDLL(library, use_errno=True).prctl
    before_ns = int(control(GET_TIMER_SLACK, 0, 0, 0, 0))
    control(SET_TIMER_SLACK, max(slack_ns, 0), 0, 0, 0)
    return before_ns
