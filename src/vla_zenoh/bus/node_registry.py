"""Registry of live nodes and their last status, for a bounded number of names.

A client that may publish a status may do so under any name. So the registry always has a place for
the nodes of the profile, and a quota for all others; `up` runs for weeks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import key_chunk
from vla_zenoh.types import NodeStatus

MAX_OTHERS = 256
"""Names beside those of the profile."""
MAX_STATUS_BYTES = 64 * 1024
"""Of one status; ours have a few thousand bytes."""
MAX_OTHERS_BYTES = 4 * 1024 * 1024
"""Of all statuses of other names."""


@dataclass(slots=True)
class _LastStatus:
    status: NodeStatus
    size: int
    received_s: float


class NodeRegistry:
    """Live nodes and their last status; safe to use from several threads.

    Args:
        expected: nodes of the profile, which always have a place.
        clock: seconds that never go back.
    """

    def __init__(
        self, expected: Iterable[str] = (), clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._expected = frozenset(expected)
        self._clock = clock
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._ours: dict[str, _LastStatus] = {}
        self._others: dict[str, _LastStatus] = {}
        self._others_bytes = 0
        self._dropped = 0

    @property
    def alive(self) -> frozenset[str]:
        """Names of live nodes."""
        with self._lock:
            return frozenset(self._alive)

    @property
    def dropped(self) -> int:
        """Statuses and tokens that were not kept, or made room for others."""
        return self._dropped

    def token_appeared(self, name: str) -> None:
        """Note that a liveliness token appeared."""
        with self._lock:
            others = len(self._alive - self._expected)
            if not self._fit(name) or (name not in self._expected and others >= MAX_OTHERS):
                self._dropped += 1
                return
            self._alive.add(name)

    def token_gone(self, name: str) -> None:
        """Note that a liveliness token is gone."""
        with self._lock:
            self._alive.discard(name)

    def status_received(self, name: str, status: NodeStatus, size: int) -> None:
        """Keep a status.

        Args:
            name: of the node, from the key.
            status: as received.
            size: in bytes.
        """
        with self._lock:
            if not self._fit(name) or size > MAX_STATUS_BYTES:
                self._dropped += 1
                return
            said = _LastStatus(status, size, self._clock())
            if name in self._expected:
                self._ours[name] = said
                return
            self._forget(name)
            if self._make_room(size):
                self._others[name] = said
                self._others_bytes += size
            else:
                self._dropped += 1

    def status(self, name: str) -> tuple[NodeStatus, float] | None:
        """The last status of a node and when it was received; None before the first."""
        with self._lock:
            found = self._ours.get(name) or self._others.get(name)
            return None if found is None else (found.status, found.received_s)

    def snapshot(self) -> dict[str, tuple[NodeStatus, float, bool]]:
        """Node -> (status, age in s, alive), by name."""
        now_s = self._clock()
        with self._lock:
            return {
                name: (said.status, now_s - said.received_s, name in self._alive)
                for name, said in sorted({**self._others, **self._ours}.items())
            }

    @staticmethod
    def _fit(name: str) -> bool:
        try:
            return bool(key_chunk(name, "node"))
        except ProfileError:
            return False

    def _make_room(self, size: int) -> bool:
        """Whether `size` more bytes fit, after dropping the statuses of nodes that are gone."""
        while len(self._others) >= MAX_OTHERS or self._others_bytes + size > MAX_OTHERS_BYTES:
            oldest = next((name for name in self._others if name not in self._alive), None)
            if oldest is None:
                return False
            self._forget(oldest)
            self._dropped += 1
        return True

    def _forget(self, name: str) -> None:
        said = self._others.pop(name, None)
        if said is not None:
            self._others_bytes -= said.size
