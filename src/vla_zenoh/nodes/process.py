"""What a node's process does around it: signals, the session, and not outliving its parent."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import signal
import threading
from collections.abc import Callable

import zenoh

from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import Profile

PARENT_VARIABLE = "VLA_ZENOH_PARENT"
"""Process number of the supervisor; a child whose supervisor is gone ends itself."""
PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
ROUTER_PATIENCE_S = 10.0


def stop_on_signals() -> threading.Event:
    """An event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def die_with_parent() -> None:
    """Where a supervisor started us: end in an orderly way when it dies, however it dies."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    library = ctypes.util.find_library("c")
    if library is not None:
        ctypes.CDLL(library, use_errno=True).prctl(PARENT_DEATH_SIGNAL, signal.SIGTERM, 0, 0, 0)
    if not _exists(int(parent)):  # it died before we asked
        os.kill(os.getpid(), signal.SIGTERM)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def run_node(
    profile: Profile,
    run: Callable[[zenoh.Session, threading.Event], None],
    *,
    wait_s: float | None = None,
) -> None:
    """Open a session and run a node in it until a signal comes.

    Args:
        profile: the session section is used.
        run: makes the node and runs it.
        wait_s: patience with a router that does not answer; longer under a supervisor, which may
            be starting it.

    Raises:
        SessionError: no router answers.
    """
    stop = stop_on_signals()
    die_with_parent()
    if wait_s is None:
        wait_s = ROUTER_PATIENCE_S if PARENT_VARIABLE in os.environ else 0.0
    with open_session(profile.session, wait_s=wait_s) as session:
        run(session, stop)
