"""Which pictures of a faster source go out."""

from __future__ import annotations

EARLY = 0.25
LATE = 0.2


class Pace:
    """Lets at most `rate_hz` pictures a second through, evenly and never in a burst.

    A picture may come `EARLY` periods before its time, so that a source of just this rate loses
    none to jitter. Lateness is carried over by `LATE` periods only. Together they stay under half
    a period: a source of twice the rate always gives every other picture.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._next_ns: float | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the picture of this time goes out; time may be of any clock."""
        ahead_ns = 0.0 if self._next_ns is None else self._next_ns - now_ns
        if ahead_ns > 2 * self._period_ns:  # that clock was set back
            self._next_ns, ahead_ns = None, 0.0
        if ahead_ns > EARLY * self._period_ns:
            return False
        start_ns = now_ns if self._next_ns is None else self._next_ns
        self._next_ns = max(start_ns, now_ns - LATE * self._period_ns) + self._period_ns
        return True
