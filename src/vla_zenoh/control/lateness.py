"""Lateness: ticks that a control loop missed, because its computer was busy with something else."""

from __future__ import annotations

from collections import deque

WINDOW_S = 2.0
BUSY_S = 0.05
"""A computer that lets a loop wait for this long is too busy for it; less is seen in any log."""


class Lateness:
    """How late the ticks of the last `WINDOW_S` were.

    Args:
        period_s: of the loop.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._missed: deque[tuple[int, int]] = deque()  # when, and how many ticks

    def add(self, missed: int, now_ns: int) -> None:
        """A tick at `now_ns` came after `missed` ticks that did not take place."""
        if missed > 0:
            self._missed.append((now_ns, missed))
        while self._missed and abs(now_ns - self._missed[0][0]) > WINDOW_S * 1e9:
            self._missed.popleft()

    def explains(self) -> str:
        """End of a sentence about something that came too late; empty if this was not busy."""
        worst_s = max((missed for _, missed in self._missed), default=0) * self._period_s
        if worst_s < BUSY_S:
            return ""
        total = sum(missed for _, missed in self._missed)
        share = total * self._period_s / WINDOW_S
        return (
            f"; this computer is too busy: in the last {WINDOW_S:g} s {min(share, 1.0):.0%} of the "
            f"command node's ticks were missed, the latest was {worst_s:.3f} s late"
        )
