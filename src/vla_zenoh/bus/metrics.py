"""Rates and latencies of the last seconds, for status."""

from __future__ import annotations

import time
from collections import deque


class RateMeter:
    """How often something happens, over a sliding window."""

    def __init__(self, window_s: float = 2.0) -> None:
        self._window_s = window_s
        self._times: deque[float] = deque(maxlen=4096)
        self.total = 0

    def tick(self) -> None:
        """It happened."""
        self._times.append(time.monotonic())
        self.total += 1

    @property
    def rate_hz(self) -> float:
        """Events per second, 0 when nothing happened within the window."""
        now = time.monotonic()
        while self._times and now - self._times[0] > self._window_s:
            self._times.popleft()
        if len(self._times) < 2:
            return 0.0
        span_s = self._times[-1] - self._times[0]
        mean_s = span_s / (len(self._times) - 1)
        # Between two events the rate does not sink; when the next one is overdue it does.
        overdue_s = max(now - self._times[-1] - 1.5 * mean_s, 0.0)
        return (len(self._times) - 1) / max(span_s + overdue_s, 1e-6)


class Percentiles:
    """How the last values are spread."""

    def __init__(self, size: int) -> None:
        self._values: deque[float] = deque(maxlen=size)

    def add(self, value: float) -> None:
        """Take one value."""
        self._values.append(value)

    def summary(self) -> tuple[float, float] | None:
        """(p50, p95), None without values."""
        if not self._values:
            return None
        ordered = sorted(self._values)
        last = len(ordered) - 1
        return ordered[round(0.5 * last)], ordered[round(0.95 * last)]

    def spread(self) -> dict[str, float]:
        """p50, p95, p99 and max; empty without values."""
        if not self._values:
            return {}
        ordered = sorted(self._values)
        last = len(ordered) - 1
        shares = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
        return {name: round(ordered[round(share * last)], 1) for name, share in shares.items()}
