"""What a command says about the time after it: the next one may be late, or lost."""

from __future__ import annotations

from typing import Generic

import numpy as np

from vla_zenoh.control.governor import BRAKE_MARGIN, Limits, Space, Told, Way
from vla_zenoh.types import FloatArray

BELIEVED_S = 0.02
"""For how long a command's acceleration is believed; its velocity is until the stream times out."""


class Extrapolation(Generic[Told]):
    """A motion from one command on, within the limits of the stream.

    For as long as there were between this command and the one before it the acceleration goes on
    changing as it did; then it stays until the command is `BELIEVED_S` old, or less where the
    motion would get too fast or turn round; then it fades to zero, jerk-limited.

    Args:
        space: where motions lie.
        command: from which it begins.
        before: the command before that one, where it belongs to the same stream.
        gap_s: between these two.
        brake: limits of the robot's own stop, `BRAKE_MARGIN` times those of the stream.
    """

    def __init__(
        self, space: Space[Told], command: Told, before: Told | None, gap_s: float, brake: Limits
    ) -> None:
        self._space, self._base = space, space.rest(command)
        _, rate, change = space.speed(command)
        velocity_limit, acceleration_limit, jerk_limit = np.array(brake[:3]) / BRAKE_MARGIN
        jerk = np.zeros(len(rate))
        if before is not None and 0.0 < gap_s <= BELIEVED_S:
            was = space.apart(before, self._base).change
            # Who accelerates as much as it may will not do so more and more.
            later = acceleration_limit * space.bounded((2 * change - was) / acceleration_limit)
            jerk = jerk_limit * space.bounded((later - change) / (gap_s * jerk_limit))
        else:
            gap_s = 0.0
        self._jerk, self._gap_s = jerk, gap_s
        self._first = Way(np.zeros(len(rate)), rate, change)
        self._then = _on(self._first, jerk, gap_s)
        _, rate, change = self._then
        fading_s = np.abs(change) / jerk_limit
        speed = np.abs(rate)
        room = np.where(rate * change < 0, speed, velocity_limit - speed)
        room -= 0.5 * np.abs(change) * fading_s
        steady_s = np.clip(room / np.maximum(np.abs(change), 1e-9), 0.0, BELIEVED_S - gap_s)
        self._steady_s = np.where(jerk * change < 0, 0.0, steady_s)
        self._fading_s, self._fade = fading_s, -np.sign(change) * jerk_limit

    def at(self, ahead_s: float) -> Told:
        """The motion `ahead_s` after the command."""
        if ahead_s <= self._gap_s:
            return self._space.beside(self._base, _on(self._first, self._jerk, ahead_s))
        left_s = ahead_s - self._gap_s
        way = _on(self._then, 0.0, np.minimum(left_s, self._steady_s))
        fading_s = np.clip(left_s - self._steady_s, 0.0, self._fading_s)
        way = _on(way, self._fade, fading_s)
        rest_s = np.maximum(left_s - self._steady_s - self._fading_s, 0.0)
        faded = fading_s >= self._fading_s
        way = way._replace(change=np.where(faded, 0.0, way.change))
        return self._space.beside(self._base, _on(way, 0.0, rest_s))


def _on(way: Way, jerk: FloatArray | float, time_s: FloatArray | float) -> Way:
    value, rate, change = way
    later = change + jerk * time_s
    return Way(
        value + (rate + (2 * change + later) * (time_s / 6)) * time_s,
        rate + (change + later) * (0.5 * time_s),
        later,
    )
