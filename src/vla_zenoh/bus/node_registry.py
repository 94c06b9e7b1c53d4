"""Registry of live nodes and their last status, for a bounded number of names.

Any client that may publish a status may do so under any name. So the registry always has a place
for the nodes of the profile, and a quota for all others; `up` runs for weeks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import key_chunk
from vla_zenoh.types import NodeStatus

MAX_OTHERS = 256
"""Names beside those of the profile."""
MAX_STATUS_BYTES = 64 * 1024
"""Of one status; ours have a few thousand bytes."""


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
        self._statuses: dict[str, tuple[NodeStatus, float]] = {}  # the newest comes last
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
            self._statuses.pop(name, None)
            if name in self._expected or self._make_room():
                self._statuses[name] = (status, self._clock())
            else:
                self._dropped += 1

    def status(self, name: str) -> tuple[NodeStatus, float] | None:
        """The last status of a node and when it was received; None before the first."""
        with self._lock:
            return self._statuses.get(name)

    def snapshot(self) -> dict[str, tuple[NodeStatus, float, bool]]:
        """Node -> (status, age in s, alive), by name."""
        now_s = self._clock()
        with self._lock:
            return {
                name: (status, now_s - received_s, name in self._alive)
                for name, (status, received_s) in sorted(self._statuses.items())
            }

    @staticmethod
    def _fit(name: str) -> bool:
        try:
            return bool(key_chunk(name, "node"))
        except ProfileError:
            return False

    def _make_room(self) -> bool:
        """Whether one more status fits, after dropping the oldest of a node that is gone."""
        others = [name for name in self._statuses if name not in self._expected]
        if len(others) < MAX_OTHERS:
            return True
        oldest = next((name for name in others if name not in self._alive), None)
        if oldest is None:
            return False
        del self._statuses[oldest]
        self._dropped += 1
        return True
