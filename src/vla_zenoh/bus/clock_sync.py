"""Clocks of other nodes: asks them over Zenoh, and puts their stamps on our own clock.

A node asks those whom it was told of, and those whose streams it reads. It never waits for an
answer. A header may name whom it likes, so names that only headers say have a place of their own.
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
"""The first so many questions follow each other quickly: one of them will be undisturbed."""
PATIENCE_S = 2.0
FORGET_S = 30.0
"""Who has not answered for so long has no clock we know of."""
HEARD_PATIENCE_S = 2.0
"""A name that only a header says, and that never answered, makes room after so long."""
MAX_PEERS, MAX_HEARD = 64, 32
"""Clocks of nodes that we were told of, and of names that only a header says."""
MAX_STAMPS_BYTES = 1024
Record = TypeVar("Record")


@dataclass(slots=True)
class _Peer:
    key: str
    filter: ClockOffsetFilter
    since_s: float
    told: bool
    asks: int = 0
    next_ask_s: float = 0.0
    answered_s: float = -1e9

    def forgotten(self, now_s: float) -> bool:
        """It has been silent for so long that others may have its place."""
        real = self.told or self.answered_s > 0
        silent_s = now_s - max(self.answered_s, self.since_s)
        return silent_s > (FORGET_S if real else HEARD_PATIENCE_S)


class ClockSync:
    """See the module.

    Args:
        session: open session.
        keys: of the robot.
        clock: our own.
        name: our own node's, whose clock needs no asking.
        bound_s: a clock that is off by more is wrong, and its stamps stay as they are.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, clock: Clock, name: str, bound_s: float
    ) -> None:
        self._session, self._keys, self._clock, self._name = session, keys, clock, name
        self._bound_s = bound_s
        self._lock = threading.Lock()
        self._peers: dict[str, _Peer] = {}
        self._next_look_s = 0.0

    # -- asking -------------------------------------------------------------------------------
    def track(self, node: str) -> None:
        """From now on know the clock of `node`, which lives.

        What cannot be a node's name is left out.
        """
        self._follow(node, told=True)

    def _follow(self, node: str, *, told: bool) -> None:
        known = self._peers.get(node)
        if known is not None:
            known.told = known.told or told
            return
        others = sum(peer.told is told for peer in list(self._peers.values()))
        if node == self._name or others >= (MAX_PEERS if told else MAX_HEARD):
            return
        try:
            key = self._keys.clock(node)
        except ProfileError:
            return
        with self._lock:
            self._peers[node] = _Peer(key, ClockOffsetFilter(self._bound_s), time.monotonic(), told)
        self._next_look_s = 0.0

    def tick(self) -> None:
        """Ask whoever is due. Cheap; call it from the loop that owns the node."""
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
                with self._lock:  # room for others; who is still heard comes back
                    del self._peers[node]

    def _ask(self, peer: _Peer) -> None:
        asked_ns = time.monotonic_ns()

        def take(reply: zenoh.Reply) -> None:
            got_ns = time.monotonic_ns()
            if reply.ok is None:
                return
            try:
                heard_ns, said_ns = decode_stamps(bytes_of(reply.ok.payload, MAX_STAMPS_BYTES))
            except CodecError:
                return  # whoever answers that has no clock we could use
            with self._lock:
                if peer.filter.add(Exchange(asked_ns, heard_ns, said_ns, got_ns)):
                    peer.answered_s = time.monotonic()

        self._session.get(
            peer.key,
            zenoh.handlers.Callback(take, indirect=False),
            timeout=PATIENCE_S,
            **QOS[Kind.CONTROL],
        )

    # -- knowing ------------------------------------------------------------------------------
    def offsets(self) -> dict[str, ClockOffset]:
        """Node -> its clock minus ours, of those that answered lately."""
        now_ns, now_s = time.monotonic_ns(), time.monotonic()
        with self._lock:
            found = {
                node: peer.filter.offset(self._clock.offset_ns, now_ns)
                for node, peer in self._peers.items()
                if now_s - peer.answered_s < FORGET_S
            }
        return {node: offset for node, offset in found.items() if offset is not None}

    def to_local_clock(self, header: Header, record: Record) -> tuple[Header, Record]:
        """Header and record with their stamps on our own clock."""
        node = header.source.partition("#")[0]
        ahead_ns = self._ahead_ns(node)
        if not ahead_ns:
            return header, record
        return shift_stamps(header, record, ahead_ns)

    def _ahead_ns(self, node: str) -> int:
        peer = self._peers.get(node)
        if peer is None:
            self._follow(node, told=False)
            return 0
        with self._lock:
            return peer.filter.applied_ns(self._clock.offset_ns, time.monotonic_ns())


def reply_with_stamps(clock: Clock, key: str, query: zenoh.Query) -> None:
    """Tell when the question was heard, and when it is answered."""
    heard_ns = clock.wall_ns()
    reply = {"heard_ns": heard_ns, "said_ns": clock.wall_ns()}
    query.reply(key, message.pack(reply))


def decode_stamps(payload: bytes) -> tuple[int, int]:
    """When a question was heard and answered, on the other one's wall clock, ns.

    Raises:
        CodecError: it says something else.
    """
    found = message.unpack(payload)
    heard, said = (
        (found.get("heard_ns"), found.get("said_ns")) if isinstance(found, dict) else (None, None)
    )
    if type(heard) is not int or type(said) is not int:
        raise CodecError("shape", "a clock answers with heard_ns and said_ns")
    return heard, said
