"""A parallel gripper's own controller: a width that runs at a speed, and a bounded force."""

from __future__ import annotations

from vla_zenoh.errors import RecordError

AT_REST_M_S = 2e-3
AT_REST_TICKS = 50  # as many milliseconds of standstill before "holding" is said
HELD_MARGIN_M = 5e-4  # commanded narrower than measured by this much: something is in between
DEFAULT_FORCE_N = 20.0


class GripperServo:
    """Turns the newest command into a set width per tick and judges what the fingers do.

    Args:
        max_width_m: opening of the fingers at their stops.
        period_s: time between two calls of `step`.
        max_force_n: commands above it are cut.
    """

    def __init__(self, max_width_m: float, period_s: float, max_force_n: float) -> None:
        self.max_width_m = max_width_m
        self.max_force_n = max_force_n
        self._period_s = period_s
        self.reset(max_width_m)

    def reset(self, width_m: float) -> None:
        """Stand at `width_m` with the default force."""
        self.force_n = min(DEFAULT_FORCE_N, self.max_force_n)
        self._target_m = self._set_m = self._measured_m = width_m
        self._step_m = 0.0
        self._rest_ticks = AT_REST_TICKS

    def command(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Go to `width_m`; replaces what was commanded before.

        Raises:
            RecordError: speed or force are not above zero.
        """
        if not speed_m_s > 0.0 or not force_n > 0.0:
            raise RecordError(
                f"a gripper needs speed and force above 0, got {speed_m_s} and {force_n}"
            )
        target = min(max(width_m, 0.0), self.max_width_m)
        # Squeezing goes on from where the ramp is, else a repeated command would let go for a
        # moment; a turn-about starts at the fingers, else it would lag by the whole squeeze.
        if (target - self._measured_m) * (self._set_m - self._measured_m) <= 0.0:
            self._set_m = self._measured_m
        self._target_m = target
        self._step_m = speed_m_s * self._period_s
        self.force_n = min(force_n, self.max_force_n)
        if abs(target - self._measured_m) > HELD_MARGIN_M and not self.holding:
            self._rest_ticks = 0

    def step(self, width_m: float, rate_m_s: float) -> float:
        """Take the measured opening and its rate; give the set width of this tick."""
        self._measured_m = width_m
        self._rest_ticks = self._rest_ticks + 1 if abs(rate_m_s) < AT_REST_M_S else 0
        left = self._target_m - self._set_m
        self._set_m += min(max(left, -self._step_m), self._step_m)
        return self._set_m

    @property
    def moving(self) -> bool:
        """The fingers move, or are just about to."""
        return self._rest_ticks < AT_REST_TICKS

    @property
    def holding(self) -> bool:
        """The fingers stand still wider than commanded: an object keeps them apart."""
        squeezing = self._measured_m - self._set_m > HELD_MARGIN_M
        return squeezing and not self.moving
