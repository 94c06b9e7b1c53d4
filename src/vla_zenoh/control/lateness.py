"""Lateness: ticks that a control loop missed, because its computer was busy with something else."""

from __future__ import annotations

from collections import deque

WINDOW_S = 2.0
"""What was late longer ago explains nothing that is too late now."""
BUSY_S = 0.05
"""A computer that lets a loop wait for this long is too busy for it; less is seen in any log."""


class Lateness:
    """How late the ticks of the last `WINDOW_S` were.

    Args:
        period_s: of the loop.
        whose: node, in sentences.
    """

    def __init__(self, period_s: float, whose: str = "the command node") -> None:
        self._period_s, self._whose = period_s, whose
        self._missed: deque[tuple[int, int]] = deque()  # when, and how many ticks

    def add(self, missed: int, now_ns: int) -> None:
        """A tick at `now_ns` came after `missed` ticks that did not take place."""
        if missed > 0:
            self._missed.append((now_ns, missed))
        while self._missed and abs(now_ns - self._missed[0][0]) > WINDOW_S * 1e9:
            self._missed.popleft()

    def figures(self) -> tuple[float, float]:
        """Share of the ticks that were missed, and how late the latest one was, in s."""
        worst = max((missed for _, missed in self._missed), default=0)
        total = sum(missed for _, missed in self._missed)
        return min(total * self._period_s / WINDOW_S, 1.0), worst * self._period_s

    def sentence(self) -> str:
        """That this computer is too busy, with figures; empty if it is not."""
        share, worst_s = self.figures()
        if worst_s < BUSY_S:
            return ""
        return (
            f"this computer is too busy: in the last {WINDOW_S:g} s {share:.0%} of the ticks of "
            f"{self._whose} were missed, the latest was {worst_s:.3f} s late"
        )

    def explains(self) -> str:
        """End of a sentence about something that came too late; empty if this was not busy."""
        why = self.sentence()
        return why and f"; {why}"
