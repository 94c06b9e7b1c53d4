"""Clock synchronisation: measures the clock offsets of other nodes and converts their stamps.

A node queries the nodes it knows to be alive, and those whose streams it receives; it never waits
for a reply. A header may name any source, so names known from headers alone have a separate quota.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import TypeVar

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.session import QOS
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.keys import Keys, Kind
from vla_zenoh.ntp import ClockOffset, ClockOffsetFilter, Exchange, shift_stamps
from vla_zenoh.types import Header

ASK_PERIOD_S = 1.0
FIRST_ASKS, FIRST_PERIOD_S = 8, 0.1
"""The first queries follow each other quickly: one of them will be undisturbed."""
PATIENCE_S = 2.0
FORGET_S = 30.0
"""An offset is discarded after this time without a reply."""
HEARD_PATIENCE_S = 2.0
"""A name known from headers alone that never replied makes room after this time."""
MAX_PEERS, MAX_HEARD = 64, 32
"""Nodes known to be alive, and names known from headers alone."""
MAX_STAMPS_BYTES = 1024
Record = TypeVar("Record")


@dataclass(slots=True)
class _Peer:
    key: str
    filter: ClockOffsetFilter
    since_s: float
    alive: bool
    asks: int = 0
    next_ask_s: float = 0.0
    answered_s: float = -1e9

    def forgotten(self, now_s: float) -> bool:
        """Silent for so long that another peer may take its place."""
        real = self.alive or self.answered_s > 0
        silent_s = now_s - max(self.answered_s, self.since_s)
        return silent_s > (FORGET_S if real else HEARD_PATIENCE_S)


class ClockSync:
    """Clock offsets of the nodes other than `name`, and stamps converted with them.

    A clock that is off by more than `bound_s` is wrong; its stamps are not converted.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, clock: Clock, name: str, bound_s: float
    ) -> None:
        self._session, self._keys, self._clock, self._name = session, keys, clock, name
        self._bound_s = bound_s
        self._lock = threading.Lock()
        self._peers: dict[str, _Peer] = {}
        self._next_look_s = 0.0

    # -- queries ------------------------------------------------------------------------------
    def track(self, node: str, *, alive: bool = True) -> None:
        """Measure the clock of `node` from now on; invalid names are ignored."""
        known = self._peers.get(node)
        if known is not None:
            known.alive = known.alive or alive
            return
        others = sum(peer.alive is alive for peer in list(self._peers.values()))
        if node == self._name or others >= (MAX_PEERS if alive else MAX_HEARD):
            return
        try:
            key = self._keys.clock(node)
        except ProfileError:
            return
        with self._lock:
            self._peers[node] = _Peer(
                key, ClockOffsetFilter(self._bound_s), time.monotonic(), alive
            )
        self._next_look_s = 0.0

    def poll(self) -> None:
        """Send the queries that are due. Cheap; call it from the loop of the node."""
        now_s = time.monotonic()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + FIRST_PERIOD_S / 2
        for node, peer in list(self._peers.items()):
            if now_s >= peer.next_ask_s:
                peer.asks += 1
                peer.next_ask_s = now_s + (
                    FIRST_PERIOD_S if peer.asks <= FIRST_ASKS else ASK_PERIOD_S
                )
                self._ask(peer)
            if peer.forgotten(now_s):
                with self._lock:  # room for others; it comes back with its next sample
                    del self._peers[node]

    def _ask(self, peer: _Peer) -> None:
        asked_ns = time.monotonic_ns()

        def on_reply(reply: zenoh.Reply) -> None:
            got_ns = time.monotonic_ns()
            if reply.ok is None:
                return
            try:
                heard_ns, said_ns = decode_stamps(bytes_of(reply.ok.payload, MAX_STAMPS_BYTES))
            except CodecError:
                return  # not one of our nodes' clocks
            with self._lock:
                if peer.filter.add(Exchange(asked_ns, heard_ns, said_ns, got_ns)):
                    peer.answered_s = time.monotonic()

        self._session.get(
            peer.key,
            zenoh.handlers.Callback(on_reply, indirect=False),
            timeout=PATIENCE_S,
            **QOS[Kind.CONTROL],
        )

    # -- results ------------------------------------------------------------------------------
    def offsets(self) -> dict[str, ClockOffset]:
        """Node -> its clock minus ours, of those that replied lately."""
        now_ns, now_s = time.monotonic_ns(), time.monotonic()
        with self._lock:
            found = {
                node: peer.filter.offset(self._clock.offset_ns, now_ns)
                for node, peer in self._peers.items()
                if now_s - peer.answered_s < FORGET_S
            }
        return {node: offset for node, offset in found.items() if offset is not None}

    def to_local_clock(self, header: Header, record: Record) -> tuple[Header, Record]:
        """Header and record with their stamps converted to our clock."""
        node = header.source.partition("#")[0]
        ahead_ns = self._ahead_ns(node)
        if not ahead_ns:
            return header, record
        return shift_stamps(header, record, ahead_ns)

    def _ahead_ns(self, node: str) -> int:
        peer = self._peers.get(node)
        if peer is None:
            self.track(node, alive=False)
            return 0
        with self._lock:
            return peer.filter.applied_ns(self._clock.offset_ns, time.monotonic_ns())


def reply_with_stamps(clock: Clock, key: str, query: zenoh.Query) -> None:
    """Reply to a clock query with the times of its arrival and of this reply."""
    heard_ns = clock.wall_ns()
    reply = {"heard_ns": heard_ns, "said_ns": clock.wall_ns()}
    query.reply(key, message.pack(reply))


def decode_stamps(payload: bytes) -> tuple[int, int]:
    """Times of arrival and reply of a clock query, on the peer's wall clock, ns.

    Raises:
        CodecError: the payload is something else.
    """
    found = message.unpack(payload)
    found = found if isinstance(found, dict) else {}
    heard, said = found.get("heard_ns"), found.get("said_ns")
    if type(heard) is not int or type(said) is not int:
        raise CodecError("shape", "a clock replies with heard_ns and said_ns")
    return heard, said
