"""A token bucket."""

from __future__ import annotations


class RateLimit:
    """Limits how many messages are taken: `rate_hz` for long, `burst` at once.

    Args:
        now_s: monotonic.
    """

    def __init__(self, rate_hz: float, burst: float, now_s: float = 0.0) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._left, self._at_s = burst, now_s

    def take(self, now_s: float) -> bool:
        """Whether one more is within the limit."""
        self._left = min(self._burst, self._left + (now_s - self._at_s) * self._rate_hz)
        self._at_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True
