"""What a command says about the time after it: the next one may be late, or lost."""

from __future__ import annotations

from functools import cached_property
from typing import Generic

import numpy as np

from vla_zenoh.guard.command_stream import ACCELERATE_S, BRAKE_MARGIN
from vla_zenoh.guard.reference_governor import GovernedPath, GovernorLimits, Reference, Space
from vla_zenoh.types import FloatArray

FADING_S = 0.07
"""For so long a command's acceleration then fades, where there is room for it: what is done in vain
has to be undone."""


class Extrapolation(Generic[Reference]):
    """A motion from one command on, within the limits of the stream.

    For as long as there were between this command and the one before it the acceleration goes on
    changing as it did; then it stays until the command is `ACCELERATE_S` old, or less where the
    motion would get too fast or turn round; then it fades to zero, jerk-limited.

    Args:
        space: where motions lie.
        command: from which it begins.
        before: the command before that one, where it belongs to the same stream.
        gap_s: between these two.
        brake: limits of the robot's own stop, `BRAKE_MARGIN` times those of the stream.
    """

    def __init__(
        self,
        space: Space[Reference],
        command: Reference,
        before: Reference | None,
        gap_s: float,
        brake: GovernorLimits,
    ) -> None:
        self._space, self._base = space, space.rest(command)
        _, rate, change = space.speed(command)
        velocity_limit, acceleration_limit, jerk_limit = np.array(brake[:3]) / BRAKE_MARGIN
        jerk = np.zeros(len(rate))
        if before is not None and 0.0 < gap_s <= ACCELERATE_S:
            was = space.apart(before, self._base).change
            # Who accelerates as much as it may will not do so more and more.
            later = _cut(space, 2 * change - was, acceleration_limit)
            jerk = _cut(space, (later - change) / gap_s, jerk_limit)
        else:
            gap_s = 0.0
        self._jerk, self._gap_s = jerk, gap_s
        self._first = GovernedPath(np.zeros(len(rate)), rate, change)
        self._limits = velocity_limit, jerk_limit

    @cached_property
    def _later(self) -> tuple[GovernedPath, FloatArray, FloatArray, FloatArray]:
        """What comes when the next command does not: from where, how long steady, fading, how."""
        velocity_limit, jerk_limit = self._limits
        then = _on(self._first, self._jerk, self._gap_s)
        change, speed = np.maximum(np.abs(then.change), 1e-9), np.abs(then.rate)
        turning = then.rate * then.change < 0
        # Twice the time for which the acceleration may last before the motion is too fast or turns.
        room_s = 2 * np.where(turning, speed, velocity_limit - speed) / change
        fading_s = np.maximum(np.minimum(room_s, FADING_S), change / jerk_limit)
        steady_s = np.clip((room_s - fading_s) / 2, 0.0, ACCELERATE_S - self._gap_s)
        steady_s[self._jerk * then.change < 0] = 0.0
        return then, steady_s, fading_s, -then.change / fading_s

    def at(self, ahead_s: float) -> Reference:
        """The motion `ahead_s` after the command."""
        if ahead_s <= self._gap_s:
            return self._space.beside(self._base, _on(self._first, self._jerk, ahead_s))
        way, steady_s, fading_s, fade = self._later
        left_s = ahead_s - self._gap_s - steady_s
        way = _on(way, 0.0, np.minimum(left_s, 0.0) + steady_s)
        way = _on(way, fade, np.clip(left_s, 0.0, fading_s))
        left_s = np.maximum(left_s - fading_s, 0.0)
        way.change[left_s > 0.0] = 0.0
        return self._space.beside(self._base, _on(way, 0.0, left_s))


def _cut(space: Space[Reference], values: FloatArray, limits: FloatArray) -> FloatArray:
    return values / np.maximum(space.sizes(values / limits), 1.0)


def _on(way: GovernedPath, jerk: FloatArray | float, time_s: FloatArray | float) -> GovernedPath:
    value, rate, change = way
    later = change + jerk * time_s
    return GovernedPath(
        value + (rate + (2 * change + later) * (time_s / 6)) * time_s,
        rate + (change + later) * (0.5 * time_s),
        later,
    )
