"""What surrounds a node in its process: signals, its supervisor and the session.

A child ends when its supervisor dies. Zenoh and the session are imported late: that watch runs
before everything else.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from vla_zenoh.runtime.scheduling import prctl, prefer_this_process, realtime_links

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
    """An event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
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
    # A supervisor may still be starting the router.
    wait_s = ROUTER_PATIENCE_S if PARENT_VARIABLE in os.environ else 0.0
    try:
        with realtime_links() if preferred else nullcontext():
            session = open_session(profile.session, identity=identity, wait_s=wait_s, stop=stop)
    except SessionError:
        if stop.is_set():
            return
        raise
    with session:
        run(session, stop)
