"""How far the robot's clock is from ours, by the stamps of what it sends.

A message cannot arrive before it was sent: the least of (arrival - stamp) over the last seconds is
the offset of the clocks plus the shortest way, and the way of small messages is short.
"""

from __future__ import annotations

from collections import deque

WINDOW = 1000
"""Messages looked back on."""
TOLERATED_NS = 20_000_000
"""Nearer than this clocks count as equal: it is what the command node's preflight allows."""


class RobotClock:
    """Takes stamps and arrivals, both in ns since the epoch."""

    def __init__(self) -> None:
        self._delays_ns: deque[int] = deque(maxlen=WINDOW)
        self.unstamped = 0

    def take(self, stamp_ns: int, arrived_ns: int) -> None:
        """A message of this stamp came; 0 is none."""
        if stamp_ns == 0:
            self.unstamped += 1
            return
        self._delays_ns.append(arrived_ns - stamp_ns)

    @property
    def offset_s(self) -> float | None:
        """By how much the robot's clock is behind ours at most; negative: it is ahead."""
        return min(self._delays_ns) / 1e9 if self._delays_ns else None

    @property
    def differs(self) -> bool:
        """The clocks are further apart than is tolerated."""
        offset_s = self.offset_s
        return offset_s is not None and abs(offset_s) * 1e9 > TOLERATED_NS
