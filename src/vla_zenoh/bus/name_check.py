"""Finds another node of the same name that the router did not know of yet.

A node that starts asks the router which nodes are alive. But a router that was just restarted does
not know those that still reconnect; and one that was away for long may have been replaced. So a
node that has just come asks for its own name as well, and ends if another one answers: who is there
already stays.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.clock import MAX_STAMPS_BYTES, suspended_ns
from vla_zenoh.bus.session import PATIENCE_S, QOS
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Kind
from vla_zenoh.types import ClockReply

NEW_S = 5.0
"""A node counts as new for this long after it came; after a router's restart a node is linked again
within 0.5 s."""
AWAY_S = 10.0
"""A node without a link, or stopped, for longer than this may have been replaced: it is new."""
ASK_PERIOD_S = 0.25


class NameCheck:
    """Whether another node answers on `key`, which every node answers on its own.

    `routes` means a router's session. Call `poll` from the loop of the node.
    """

    def __init__(self, session: zenoh.Session, key: str, *, routes: bool = False) -> None:
        self._session, self._key, self._routes = session, key, routes
        self._linked_s = self._came_s = self._now_s()
        self._next_ask_s = 0.0
        self._answered = threading.Event()

    @property
    def taken(self) -> bool:
        """Whether another node of this name was there when this one came."""
        return self._answered.is_set()

    def poll(self) -> None:
        """Ask when it is due."""
        now_s = self._now_s()
        if self._routes or self._session.info.routers_zid():
            if now_s - self._linked_s > AWAY_S:
                self._came_s = now_s
            self._linked_s = now_s
        if now_s - self._came_s < NEW_S and now_s >= self._next_ask_s:
            self._next_ask_s = now_s + ASK_PERIOD_S
            self._ask()

    def _ask(self) -> None:
        def on_reply(reply: zenoh.Reply) -> None:
            with suppress(CodecError):  # not one of our nodes
                if reply.ok is not None:
                    records.decode(ClockReply, bytes_of(reply.ok.payload, MAX_STAMPS_BYTES))
                    self._answered.set()

        self._session.get(
            self._key,
            zenoh.handlers.Callback(on_reply, indirect=False),
            timeout=PATIENCE_S,
            allowed_destination=zenoh.Locality.REMOTE,
            **QOS[Kind.CONTROL],
        )

    @staticmethod
    def _now_s() -> float:
        """Monotonic, and counts while the computer is suspended."""
        return (time.monotonic_ns() + suspended_ns()) / 1e9
