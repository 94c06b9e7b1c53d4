"""Which observations of a robot are answered: fresh ones, each once, of one robot. No clock."""

from __future__ import annotations

from dataclasses import dataclass

from vla_zenoh.errors import CodecError
from vla_zenoh_r2c.wire import Seen

EARLY_S = 0.1
"""A stamp may lie this far in the future before a clock counts as wrong."""
RESTARTS_S = 1.0
"""A robot takes longer than this to start again and count its ids from the beginning."""


@dataclass(slots=True)
class Admission:
    """Knows the observation that was admitted last.

    Args:
        max_age_s: older observations are refused.
    """

    max_age_s: float
    _id: int = 0
    _stamp_ms: int = 0
    _at_s: float = float("-inf")
    _doubted: bool = False

    def admit(self, seen: Seen, wall_ms: float, now_s: float) -> bool:
        """Admit an observation; whether it begins an episode: the robot has started (again).

        Args:
            seen: the observation.
            wall_ms: wall clock.
            now_s: monotonic clock.

        Raises:
            CodecError: it is ``stale``, ``early``, ``replayed`` or ``foreign``.
        """
        age_s = (wall_ms - seen.stamp_ms) / 1e3
        if age_s > self.max_age_s:
            raise CodecError(
                "stale", f"observation {seen.id} is {age_s:.2f} s old, at most {self.max_age_s:g} s"
            )
        if age_s < -EARLY_S:
            raise CodecError(
                "early",
                f"observation {seen.id} is {-age_s:.2f} s in the future; synchronise the clocks "
                "(chrony or ptp)",
            )
        if seen.stamp_ms <= self._stamp_ms:
            raise CodecError("replayed", f"observation {seen.id} is not newer than {self._id}")
        begins = seen.id <= self._id or self._id == 0
        if begins and now_s - self._at_s < RESTARTS_S:
            self._doubted = True  # it may be the robot itself, which has restarted at once
            raise CodecError(
                "foreign",
                f"observation {seen.id} came {now_s - self._at_s:.2f} s after {self._id}: another "
                "robot publishes as this device",
            )
        begins, self._doubted = begins or self._doubted, False
        self._id, self._stamp_ms, self._at_s = seen.id, seen.stamp_ms, now_s
        return begins
