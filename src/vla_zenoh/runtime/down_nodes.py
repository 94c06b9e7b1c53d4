"""Publishes for the nodes of this host that are down that they crashed or are starting.

A node that cannot start cannot publish its reason; without this it would be in one terminal only.
The status is published in the node's name and with its certificate, on its own keys, which no other
role may put.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import zenoh

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.host import HostId, own_host_id
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import CRASHED, ON_BEHALF, STARTING, Kind
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.supervisor import Child
from vla_zenoh.types import Event, NodeStatus

PERIOD_S = 0.5
MAX_WHY = 1000


class DownNodes:
    """Publishes the status of nodes that are down, in a thread, until `close`.

    Args:
        profile: the effective profile.
        session: of the operator at this computer; in a secured lab each node gets its own.
        host: of the profile.
        down: the nodes that are down now.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        host: str,
        down: Callable[[], Sequence[Child]],
    ) -> None:
        self._profile, self._session, self._down = profile, session, down
        self._host_id = own_host_id(profile.session, host)
        self._voices: dict[str, _Voice] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="down nodes", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and its sessions."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(PERIOD_S):
            # If the router is down, so is every subscriber.
            with suppress(VlaZenohError, zenoh.ZError):
                self._publish(self._down())
        self._publish(())

    def _publish(self, down: Sequence[Child]) -> None:
        for name in self._voices.keys() - {child.command.name for child in down}:
            self._voices.pop(name).close()
        for child in down:
            name = child.command.name
            if name not in self._voices:
                self._voices[name] = _Voice(self._profile, name, self._session)
            self._voices[name].publish(child, self._host_id)


class _Voice:
    """Publishers of one node that is down."""

    def __init__(self, profile: Profile, name: str, session: zenoh.Session) -> None:
        self._own: zenoh.Session | None = None
        if profile.session.security is not None:
            session = self._own = open_session(profile.session, identity=name)
        keys, clock = profile.keys, Clock()
        source = f"{ON_BEHALF}{name}#{secrets.token_hex(4)}"
        self._name, self._since_wall_ns, self._crashes = name, time.time_ns(), 0
        self._status = Publisher(session, keys.status(name), Kind.TELEMETRY, source, clock)
        self._event = Publisher(session, keys.event(name), Kind.TELEMETRY, source, clock)

    def publish(self, child: Child, on: HostId) -> None:
        crashes, state, why = child.deaths_in_a_row, STARTING, ""
        if crashes:
            state = CRASHED
            times = "once" if crashes == 1 else f"{crashes} times"
            then = (
                "correct that and restart `up` there" if child.left_alone else "it is started again"
            )
            end = child.end.encode("utf-8", "replace").decode()[:MAX_WHY]
            why = f"crashed {times}: {end}; {then}"
        if crashes > self._crashes:
            self._event.publish(Event("error", "fault", CRASHED, why))
        self._crashes = crashes
        detail = {"complaint": why, "crashes": crashes, "given_up": child.left_alone}
        status = NodeStatus(
            self._name, state, on.host, child.pid, self._since_wall_ns, detail=detail, boot=on.boot
        )
        self._status.publish(status)

    def close(self) -> None:
        self._status.undeclare()
        self._event.undeclare()
        if self._own is not None:
            self._own.close()
