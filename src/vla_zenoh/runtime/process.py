"""What surrounds a node in its process: signals, its supervisor, priorities and the session.

A child ends when its supervisor dies. Zenoh and the session are imported late: that watch runs
before everything else.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh

    from vla_zenoh.profile import Profile

PARENT_VARIABLE = "VLA_ZENOH_PARENT"
"""Process id of the supervisor; a child exits when that process is gone."""
RUN_FOLDER_VARIABLE = "VLA_ZENOH_RUN_FOLDER"
"""Folder where a node may keep what it needs after a restart."""
FATAL, DETAIL = "fatal: ", "detail: "
"""Prefixes of the lines by which a node reports why it exits, and the traceback of that."""
PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
WATCH = "watch over the supervisor"
LOOK_PERIOD_S = 0.25
LAST_WORDS_S = 1.5
ROUTER_PATIENCE_S = 20.0
LOOP_PRIORITY, LINK_PRIORITY = 40, 30
"""SCHED_FIFO priorities: no link thread may preempt a control loop."""
INNER_PRIORITY = 45
"""Of a robot's own loop inside a driver library, which is faster than ours."""
NICENESS = -10
SET_TIMER_SLACK, GET_TIMER_SLACK = 29, 30  # PR_SET_TIMERSLACK and PR_GET_TIMERSLACK of prctl(2)


def die_with_parent() -> None:
    """Under a supervisor: exit in an orderly way when it dies, for whatever reason.

    Linux signals the child at once. A process in between (uv, for a model with its own environment)
    swallows that signal, and other systems have none: so we poll as well. A process that does not
    exit within `LAST_WORDS_S`, because it hangs in a library, is killed.
    """
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    prctl(PARENT_DEATH_SIGNAL, signal.SIGTERM)
    if not is_running(int(parent)):  # it died before we asked
        os.kill(os.getpid(), signal.SIGTERM)
    if not any(thread.name == WATCH for thread in threading.enumerate()):
        threading.Thread(target=_watch, args=(int(parent),), name=WATCH, daemon=True).start()


def _watch(parent: int) -> None:
    while is_running(parent):
        time.sleep(LOOK_PERIOD_S)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(LAST_WORDS_S)
    os._exit(1)


def is_running(pid: int) -> bool:
    """Whether a process of this id runs; a zombie does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return not Path("/proc/self").exists()  # without /proc, what can be signalled runs
    return stat.rpartition(") ")[2][:1] not in ("Z", "X")


def stop_on_signals() -> threading.Event:
    """An event that SIGINT, SIGTERM and a terminal that is closed set; under nohup it is not."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: stop.set())
    return stop


def run_node(
    profile: Profile,
    run: Callable[[zenoh.Session, threading.Event], None],
    *,
    identity: str | None,
    preferred: bool = False,
) -> None:
    """Open a session and `run` a node in it until a signal arrives.

    Args:
        identity: the node's name, for its certificate; None: the operator at this computer.
        preferred: the node keeps an arm in motion and runs before other programs, where allowed.

    Raises:
        SecurityError: its certificate is missing.
        SessionError: no router answers.
    """
    from vla_zenoh.bus.session import open_session
    from vla_zenoh.errors import SessionError

    stop = stop_on_signals()
    die_with_parent()
    if preferred:  # before Zenoh starts its threads
        prefer_this_process()
        _prefer_watch()
    # A supervisor may still be starting the router.
    wait_s = ROUTER_PATIENCE_S if PARENT_VARIABLE in os.environ else 0.0
    try:
        with realtime_links() if preferred else nullcontext():
            session = open_session(profile.session, identity=identity, wait_s=wait_s, stop=stop)
    except SessionError:
        if stop.is_set():
            return
        raise
    if PARENT_VARIABLE not in os.environ and profile.session.shared_memory:
        tell_obstacle()
    with session:
        run(session, stop)


def tell_obstacle() -> None:
    """Print why this process uses no shared memory, if it does not."""
    from vla_zenoh.bus.shared_memory import obstacle

    if why := obstacle():
        print(f"no shared memory: {why}", file=sys.stderr)


# -- priorities on a busy computer: loops that keep an arm in motion, then their links -----------
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


def _prefer_watch() -> None:
    """SCHED_FIFO for the watch over the supervisor, where permitted: see `realtime_links`."""
    watches = [thread.native_id for thread in threading.enumerate() if thread.name == WATCH]
    with suppress(OSError, AttributeError):
        for thread_id in filter(None, watches):
            os.sched_setscheduler(thread_id, os.SCHED_FIFO, os.sched_param(LINK_PRIORITY))


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
