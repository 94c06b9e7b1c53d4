"""Offset of the robot's clock from ours, by the stamps of its messages.

A message cannot arrive before it was sent: the minimum of (arrival - stamp) over the last seconds
is the offset of the clocks plus the shortest delay, and that of small messages is short.
"""

from __future__ import annotations

from collections import deque

WINDOW = 1000
"""Number of messages."""
TOLERATED_NS = 20_000_000
"""Clocks that differ by less count as equal, as in the command node's preflight."""


class RobotClock:
    """Takes stamps and arrivals, both in ns since the epoch."""

    def __init__(self) -> None:
        self._delays_ns: deque[int] = deque(maxlen=WINDOW)
        self.unstamped = 0

    def take(self, stamp_ns: int, arrived_ns: int) -> None:
        """Note the arrival of a message; a stamp of 0 is none."""
        if stamp_ns == 0:
            self.unstamped += 1
            return
        self._delays_ns.append(arrived_ns - stamp_ns)

    @property
    def offset_s(self) -> float | None:
        """Upper bound of how far the robot's clock is behind ours; negative: it is ahead."""
        return min(self._delays_ns) / 1e9 if self._delays_ns else None

    @property
    def differs(self) -> bool:
        """Whether the clocks differ by more than `TOLERATED_NS`."""
        offset_s = self.offset_s
        return offset_s is not None and abs(offset_s) * 1e9 > TOLERATED_NS
