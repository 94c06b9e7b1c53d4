"""How coarsely to draw where drawing is slow: a late picture helps nobody."""

from __future__ import annotations

COARSEST = 4
TOO_SLOW, WITH_EASE = 0.5, 0.25
"""Share of a camera's period that drawing may take before it gets coarser, and to get finer."""
MEMORY = 0.8


class Coarseness:
    """Every how many pixels one is drawn, for one camera; the rest is interpolated.

    Args:
        rate_hz: pictures per second that are wanted.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._mean_s: float | None = None
        self.step = 1

    def took(self, seconds: float) -> None:
        """A picture took this long to draw."""
        mean_s = seconds if self._mean_s is None else self._mean_s
        mean_s = MEMORY * mean_s + (1 - MEMORY) * seconds
        self._mean_s = mean_s
        if mean_s > TOO_SLOW * self._period_s and self.step < COARSEST:
            self._change(self.step + 1)
        elif self.step > 1:
            finer = self.step - 1
            if mean_s * (self.step / finer) ** 2 < WITH_EASE * self._period_s:
                self._change(finer)

    def _change(self, step: int) -> None:
        # What was measured says nothing of the new step; scaled by pixels it is a fair guess.
        if self._mean_s is not None:
            self._mean_s *= (self.step / step) ** 2
        self.step = step
