"""What surrounds a node in its process: signals and the session."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from contextlib import nullcontext

import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.parent_watch import PARENT_VARIABLE, die_with_parent
from vla_zenoh.runtime.scheduling import prefer_this_process, realtime_links

ROUTER_PATIENCE_S = 10.0


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
    wait_s: float | None = None,
    preferred: bool = False,
) -> None:
    """Open a session and run a node in it until a signal arrives.

    Args:
        profile: the session section is used.
        run: makes the node and runs it.
        identity: the node's name, for its certificate; None: the operator at this computer.
        wait_s: how long to wait for a router; longer under a supervisor, which may be starting it.
        preferred: the node keeps an arm in motion and runs before other programs, where allowed.

    Raises:
        SecurityError: its certificate is missing.
        SessionError: no router answers.
    """
    stop = stop_on_signals()
    die_with_parent()
    if preferred:  # before Zenoh starts its threads
        prefer_this_process()
    if wait_s is None:
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
