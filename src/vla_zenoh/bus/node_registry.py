"""Who is there and what each said of itself last, of no more names than a lab can have.

Whoever may write a status may write it under any name. A person's tool, and `up`, which runs for
weeks, keep the nodes of their profile whatever else is said, and of all others a bounded number.
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
"""Of one status; one of ours has a few thousand."""
MAX_OTHERS_BYTES = 4 * 1024 * 1024
"""Of all statuses of names beside those of the profile."""


@dataclass(slots=True)
class _Said:
    status: NodeStatus
    size: int
    heard_s: float


class NodeRegistry:
    """See the module. May be called from several threads.

    Args:
        expected: nodes of the profile, which always have a place.
        clock: seconds that only go up.
    """

    def __init__(
        self, expected: Iterable[str] = (), clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._expected = frozenset(expected)
        self._clock = clock
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._ours: dict[str, _Said] = {}
        self._others: dict[str, _Said] = {}
        self._others_bytes = 0
        self._left_out = 0

    @property
    def alive(self) -> frozenset[str]:
        """Names whose token is there."""
        with self._lock:
            return frozenset(self._alive)

    @property
    def dropped(self) -> int:
        """Statuses and tokens that were not kept, or had to go for others."""
        return self._left_out

    def token_appeared(self, name: str) -> None:
        """A token appeared."""
        with self._lock:
            others = len(self._alive - self._expected)
            if not self._fit(name) or (name not in self._expected and others >= MAX_OTHERS):
                self._left_out += 1
                return
            self._alive.add(name)

    def token_gone(self, name: str) -> None:
        """A token went."""
        with self._lock:
            self._alive.discard(name)

    def status_received(self, name: str, status: NodeStatus, size: int) -> None:
        """A status came.

        Args:
            name: of the node, by its key.
            status: what it says.
            size: in bytes.
        """
        with self._lock:
            if not self._fit(name) or size > MAX_STATUS_BYTES:
                self._left_out += 1
                return
            said = _Said(status, size, self._clock())
            if name in self._expected:
                self._ours[name] = said
                return
            self._forget(name)
            if self._make_room(size):
                self._others[name] = said
                self._others_bytes += size
            else:
                self._left_out += 1

    def status(self, name: str) -> tuple[NodeStatus, float] | None:
        """The newest status of a node and when it came, on the clock; None before the first."""
        with self._lock:
            found = self._ours.get(name) or self._others.get(name)
            return None if found is None else (found.status, found.heard_s)

    def snapshot(self) -> dict[str, tuple[NodeStatus, float, bool]]:
        """Node -> (status, seconds since it came, alive), by name."""
        now_s = self._clock()
        with self._lock:
            return {
                name: (said.status, now_s - said.heard_s, name in self._alive)
                for name, said in sorted({**self._others, **self._ours}.items())
            }

    @staticmethod
    def _fit(name: str) -> bool:
        try:
            return bool(key_chunk(name, "node"))
        except ProfileError:
            return False

    def _make_room(self, size: int) -> bool:
        """Whether one more of `size` bytes has room, when those who are gone have made it."""
        while len(self._others) >= MAX_OTHERS or self._others_bytes + size > MAX_OTHERS_BYTES:
            oldest = next((name for name in self._others if name not in self._alive), None)
            if oldest is None:
                return False
            self._forget(oldest)
            self._left_out += 1
        return True

    def _forget(self, name: str) -> None:
        said = self._others.pop(name, None)
        if said is not None:
            self._others_bytes -= said.size
