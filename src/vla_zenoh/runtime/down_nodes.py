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

import zenoh

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.host import HostId, own_host_id
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import CRASHED, ON_BEHALF, STARTING, Kind
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.supervisor import DownNode
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
        down: Callable[[], Sequence[DownNode]],
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
            try:
                self._publish(self._down())
            except (VlaZenohError, zenoh.ZError):
                continue  # the router is down, and every subscriber with it
        self._forget(())

    def _publish(self, down: Sequence[DownNode]) -> None:
        self._forget([node.name for node in down])
        for node in down:
            if node.name not in self._voices:
                self._voices[node.name] = _Voice(self._profile, node.name, self._session)
            self._voices[node.name].publish(node, self._host_id)

    def _forget(self, names: Sequence[str]) -> None:
        for name in [name for name in self._voices if name not in names]:
            self._voices.pop(name).close()


class _Voice:
    """Publishers of one node that is down."""

    def __init__(self, profile: Profile, name: str, session: zenoh.Session) -> None:
        self._own: zenoh.Session | None = None
        if profile.session.security is not None:
            session = self._own = open_session(profile.session, identity=name)
        keys, clock = profile.keys, Clock()
        source = f"{ON_BEHALF}{name}#{secrets.token_hex(4)}"
        self._since_wall_ns, self._crashes = time.time_ns(), 0
        self._status = Publisher(session, keys.status(name), Kind.TELEMETRY, source, clock)
        self._event = Publisher(session, keys.event(name), Kind.TELEMETRY, source, clock)

    def publish(self, node: DownNode, on: HostId) -> None:
        state, why = _state(node)
        if node.crashes > self._crashes:
            self._event.publish(Event("error", "fault", CRASHED, why))
        self._crashes = node.crashes
        detail = {"complaint": why, "crashes": node.crashes, "given_up": node.left_alone}
        since_ns = self._since_wall_ns
        self._status.publish(
            NodeStatus(node.name, state, on.host, node.pid, since_ns, detail=detail, boot=on.boot)
        )

    def close(self) -> None:
        self._status.undeclare()
        self._event.undeclare()
        if self._own is not None:
            self._own.close()


def _state(node: DownNode) -> tuple[str, str]:
    if not node.crashes:
        return STARTING, ""
    times = "once" if node.crashes == 1 else f"{node.crashes} times"
    then = "correct that and restart `up` there" if node.left_alone else "it is started again"
    why = node.why.encode("utf-8", "replace").decode()[:MAX_WHY]
    return CRASHED, f"crashed {times}: {why}; {then}"
