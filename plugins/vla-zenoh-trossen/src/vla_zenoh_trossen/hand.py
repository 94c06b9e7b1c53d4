"""The gripper of a WidowX AI: two fingers on one motor; no library, no clock."""

from __future__ import annotations

CLEARLY_M = 0.002
"""Less is no closing motion, and fingers further than this from the request are on an object."""
STILL_M_S = 0.004
STARTS_S = 0.3
"""A motion shows in the states within this time."""


class Hand:
    """Turns openings into the travel of a finger, and what it measures into what we publish.

    Args:
        stroke_m: the longest travel of a finger, as the controller allows it.
        velocity_m_s: the largest speed of a finger, likewise.
    """

    def __init__(self, stroke_m: float, velocity_m_s: float) -> None:
        self._stroke_m, self._velocity_m_s = stroke_m, velocity_m_s
        self.width_m = self._speed_m_s = 0.0
        self._asked_m: float | None = None
        self._asked_s = float("-inf")
        self._closes = False

    def take(self, travel_m: float, velocity_m_s: float) -> None:
        """A new measurement of the finger."""
        self.width_m, self._speed_m_s = max(0.0, 2 * travel_m), 2 * abs(velocity_m_s)

    def ask(self, width_m: float, speed_m_s: float, now_s: float) -> tuple[float, float]:
        """Travel of the finger for an opening, and how long it may take."""
        self._closes = width_m < self.width_m - CLEARLY_M
        self._asked_m, self._asked_s = width_m, now_s
        travel_m = min(max(0.0, width_m / 2), self._stroke_m)
        finger_m_s = min(speed_m_s / 2, self._velocity_m_s)
        return travel_m, abs(travel_m - self.width_m / 2) / finger_m_s

    def moving(self, now_s: float) -> bool:
        """The fingers move, or are about to."""
        return self._speed_m_s > STILL_M_S or now_s - self._asked_s < STARTS_S

    def holding(self, now_s: float) -> bool:
        """There is something between the fingers, which were to close further."""
        if self._asked_m is None or not self._closes or self.moving(now_s):
            return False
        return self.width_m > self._asked_m + CLEARLY_M
