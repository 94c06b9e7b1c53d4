"""Status of a node whose process still imports what it needs."""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import zenoh

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.host import own_host_id
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import CRASHED, ON_BEHALF, STARTING, Kind
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import PARENT_VARIABLE
from vla_zenoh.types import NodeStatus

PERIOD_S = 0.5


@contextmanager
def shown_as_starting(profile: Profile, name: str, host: str | None) -> Iterator[None]:
    """Publish that node `name` is starting, while the block runs; under `up`, that does it."""
    ended, failed = threading.Event(), threading.Event()
    given = (profile, name, host, ended, failed)
    thread = threading.Thread(target=_publish, args=given, daemon=True)
    if PARENT_VARIABLE not in os.environ:
        thread.start()
    try:
        yield
    except BaseException:
        failed.set()
        raise
    finally:
        ended.set()
        if thread.ident is not None:
            thread.join()


def _publish(
    profile: Profile,
    name: str,
    host: str | None,
    ended: threading.Event,
    failed: threading.Event,
) -> None:
    place, since_ns = own_host_id(profile.session, host), time.time_ns()
    source = f"{ON_BEHALF}{name}#{secrets.token_hex(4)}"
    starting = NodeStatus(name, STARTING, place.host, os.getpid(), since_ns, boot=place.boot)
    # Without a router nobody hears it, and the node itself says so later.
    with (
        suppress(VlaZenohError, zenoh.ZError),
        open_session(profile.session, identity=name) as session,
    ):
        key = profile.keys.status(name)
        status = Publisher(session, key, Kind.TELEMETRY, source, Clock())
        status.publish(starting)
        while not ended.wait(PERIOD_S):
            status.publish(starting)
        if failed.is_set():
            why = {"complaint": "it could not be loaded; its terminal says why"}
            status.publish(replace(starting, state=CRASHED, detail=why))
