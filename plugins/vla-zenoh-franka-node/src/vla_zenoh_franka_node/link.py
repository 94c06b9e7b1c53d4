"""The Zenoh session of a client of a franka-node."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.errors import CodecError
from vla_zenoh_franka_node import wire

ZError = zenoh.ZError
LEASE_MS = 1000
"""As the node's: the end of either is known to the other within about this time."""
TIMEOUTS_S = {"enable": 10.0, "stop": 10.0, "recover": 10.0}
TIMEOUT_S = 3.0


def open_session(endpoint: str) -> zenoh.Session:
    """A client of the node, or of a router that both have, at `endpoint`.

    Raises:
        zenoh.ZError: nobody is there.
    """
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
    }
    for setting, value in settings.items():
        config.insert_json5(setting, json.dumps(value))
    return zenoh.open(config)


class Arrived(NamedTuple):
    """A payload, and the monotonic time when it arrived."""

    at_ns: int
    payload: bytes


class Newest:
    """A subscriber that keeps the newest payload of a key."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._newest: Arrived | None = None
        self._refused = ""
        self._subscriber = session.declare_subscriber(
            key, zenoh.handlers.Callback(self._keep, indirect=False)
        )

    def _keep(self, sample: zenoh.Sample) -> None:
        try:
            self._newest = Arrived(time.monotonic_ns(), bytes_of(sample.payload, wire.MAX_BYTES))
        except CodecError as error:
            self._refused = str(error)

    def take(self) -> Arrived | None:
        """The newest since the last call.

        Raises:
            CodecError: one that came has more than `wire.MAX_BYTES`.
        """
        newest, self._newest = self._newest, None
        refused, self._refused = self._refused, ""
        if refused:
            raise CodecError("size", refused)
        return newest


def declare_publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher of targets: at once, and the newest alone counts."""
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, express=True
    )


class Verb:
    """A verb that a node was asked for, and may not have answered yet."""

    def __init__(self, session: zenoh.Session, arm: str, verb: str, request: bytes) -> None:
        self.verb = verb
        self._timeout_s = TIMEOUTS_S.get(verb, TIMEOUT_S)
        self._began_s = time.monotonic()
        key = wire.key(arm, f"cmd/{verb}")
        self._replies = session.get(key, payload=request, timeout=self._timeout_s)

    def outcome(self) -> str | None:
        """Why it was refused; empty: it was not; None: no reply yet."""
        try:
            reply = self._replies.try_recv()
        except zenoh.ZError:
            return "no reply"  # the query ended
        if reply is None:
            late = time.monotonic() - self._began_s > self._timeout_s + 1
            return "no reply" if late else None
        if reply.ok is None:
            return "no reply"
        try:
            return wire.decode_reply(bytes_of(reply.ok.payload, wire.MAX_BYTES))
        except CodecError as error:
            return str(error)

    def wait(self, sleep: Callable[[float], None] = time.sleep) -> str:
        """The same, once there is one."""
        while (outcome := self.outcome()) is None:
            sleep(0.01)
        return outcome
