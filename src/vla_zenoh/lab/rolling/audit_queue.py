"""Who put what on the keys of a robot: settings as they come in, with the session that put them."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterable
from typing import NamedTuple

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.clock import Clock
from vla_zenoh.lab.rate_limit import RateLimit

MAX_BYTES = 64 * 1024
BURST, RATE_HZ = 256, 5.0
"""Lines of one key at once, and per second in the long run: who floods one key hides nothing on
another, and does not push out what the log has."""


def allowance() -> RateLimit:
    """How many lines of one kind are let through."""
    return RateLimit(RATE_HZ, BURST, time.monotonic())


class Put(NamedTuple):
    """A sample of an audited key.

    Args:
        payload: bytes; empty where there were more than `MAX_BYTES`.
        size: of the payload as it came, bytes.
        client: number of the Zenoh session that put it, as that session says; empty: it does not.
        received_ns: wall clock of this computer.
    """

    key: str
    payload: bytes
    size: int
    deleted: bool
    client: str
    received_ns: int


class AuditQueue:
    """Subscribes to keys, and keeps their samples until `take`.

    Args:
        session: an open session; the caller closes it.
    """

    def __init__(self, session: zenoh.Session, clock: Clock) -> None:
        self._session, self._clock = session, clock
        self._lock = threading.Lock()
        self._puts: deque[Put] = deque()
        self._allowances: dict[str, RateLimit] = {}
        self._lost: Counter[str] = Counter()
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def subscribe(self, expressions: Iterable[str]) -> None:
        """Receive the samples of key expressions."""
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        for expression in expressions:
            self._subscribers.append(self._session.declare_subscriber(expression, handler))

    def _receive(self, sample: zenoh.Sample) -> None:
        size = len(sample.payload)
        payload = bytes_of(sample.payload, MAX_BYTES) if size <= MAX_BYTES else b""
        source = sample.source_info
        client = "" if source is None else str(source.source_id.zid)
        deleted = sample.kind != zenoh.SampleKind.PUT
        key = str(sample.key_expr)
        with self._lock:
            if not self._allowances.setdefault(key, allowance()).take(time.monotonic()):
                self._lost[key] += 1
                return
            now_ns = self._clock.wall_ns()
            self._puts.append(Put(key, payload, size, deleted, client, now_ns))

    def take(self) -> tuple[list[Put], Counter[str]]:
        """All since the last call, and by key how many more there were than are let through."""
        with self._lock:
            taken, self._puts = list(self._puts), deque()
            lost, self._lost = self._lost, Counter()
        return taken, lost

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
