"""Status of a node whose process still imports what it needs, or failed."""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import zenoh

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.host import HostId, own_host_id
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError, in_words
from vla_zenoh.keys import CRASHED, ON_BEHALF, STARTING, Kind
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import PARENT_VARIABLE
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, NodeStatus

PERIOD_S = 0.5
MAX_WHY = 1000
UNHEARD = (VlaZenohError, zenoh.ZError)
"""Without a router nobody hears it."""


@contextmanager
def shown_as_starting(profile: Profile, name: str, host: str | None) -> Iterator[None]:
    """Publish that node `name` is starting, while the block runs; under `up`, that does it."""
    ended = threading.Event()

    def publish() -> None:
        with suppress(*UNHEARD), _status_of(profile, name, host) as say:
            say(STARTING)
            while not ended.wait(PERIOD_S):
                say(STARTING)

    thread = threading.Thread(target=publish, daemon=True)
    if PARENT_VARIABLE not in os.environ:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if thread.ident is not None:
            thread.join()


@contextmanager
def shown_as_crashed(profile: Profile, name: str, host: str | None) -> Iterator[None]:
    """Publish why the block failed, as what node `name` crashed by; under `up`, that does it."""
    try:
        yield
    except Exception as error:
        if PARENT_VARIABLE not in os.environ:
            with suppress(*UNHEARD), _status_of(profile, name, host) as say:
                say(CRASHED, complaint=one_line(in_words(error), MAX_WHY))
        raise


class Voice:
    """Says what is known of a node that cannot speak itself, in its name and on its keys."""

    def __init__(self, session: zenoh.Session, profile: Profile, name: str, place: HostId) -> None:
        source, clock = f"{ON_BEHALF}{name}#{secrets.token_hex(4)}", Clock()
        self._name, self._place, self._since_ns = name, place, time.time_ns()
        self._status, self._event = (
            Publisher(session, key, Kind.TELEMETRY, source, clock)
            for key in (profile.keys.status(name), profile.keys.event(name))
        )

    def say(self, state: str, pid: int, **detail: Any) -> None:
        """Publish a status."""
        place = self._place
        status = NodeStatus(
            self._name, state, place.host, pid, self._since_ns, detail=detail, boot=place.boot
        )
        self._status.publish(status)

    def emit(self, event: Event) -> None:
        self._event.publish(event)

    def close(self) -> None:
        self._status.undeclare()
        self._event.undeclare()


@contextmanager
def _status_of(profile: Profile, name: str, host: str | None) -> Iterator[Callable[..., None]]:
    """Publishes a state, with what else is given, in the node's name."""
    with open_session(profile.session, identity=name) as session:
        voice = Voice(session, profile, name, own_host_id(profile.session, host))
        yield partial(voice.say, pid=os.getpid())
