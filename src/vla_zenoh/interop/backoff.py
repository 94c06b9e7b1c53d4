"""When a lost policy server is tried again; time is an argument."""

from __future__ import annotations

FIRST_S = 0.25
LONGEST_S = 2.0
"""A robot that holds waits for its server: soon again, but not in a tight loop."""


class Backoff:
    """At once, then after `FIRST_S`, twice as long each time, at most `LONGEST_S`."""

    def __init__(self) -> None:
        self.failures = 0
        self._next_s = 0.0

    def wait_s(self, now_s: float) -> float:
        """How long until the next try, 0 when it is due."""
        return max(self._next_s - now_s, 0.0)

    def failed(self, now_s: float) -> None:
        """A try has failed at `now_s`."""
        pause_s = min(FIRST_S * 2.0 ** min(self.failures, 16), LONGEST_S)
        self.failures += 1
        self._next_s = now_s + pause_s

    def succeeded(self) -> None:
        """The server answers: the next loss is tried again at once."""
        self.failures, self._next_s = 0, 0.0
