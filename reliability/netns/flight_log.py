"""What the flight recorder kept, and what it says of a fault. Pure but for reading the files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.limits import motion_limits
from vla_zenoh.control.smoothing import Smoother
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile

FloatArray = NDArray[np.float64]

COLUMNS = 15
STILL_M_S = 0.005
"""A measured arm that is slower stands: the impedance controller still settles."""
STOOD_S = 0.2
"""Slow for so long is standing; less is a turn."""
WINDOW_S = 0.02
"""The measured velocity's change is taken over so long."""
SLOWEST_S = 0.5


@dataclass(frozen=True, slots=True)
class Flight:
    """Rows of one writer, in the order of their stamps.

    Args:
        time_s: (n,) monotonic clock of the computer, which all hosts share.
        position_m: (n, 3) TCP: measured by the simulator, or commanded.
        twist: (n, 6) likewise.
        last: (n, 3) of the simulator: the position its controller follows, m; of the command node:
            the commanded acceleration, m/s^2.
        asked_s: (n,) of the command node: when the chunk that it carries out arrived, else NaN.
        heard_s: (n,) of the simulator: when it last took a command; of the command node: when it
            last heard of the arm; NaN before the first.
    """

    time_s: FloatArray
    position_m: FloatArray
    twist: FloatArray
    last: FloatArray
    asked_s: FloatArray
    heard_s: FloatArray

    @property
    def speed_m_s(self) -> FloatArray:
        return np.linalg.norm(self.twist[:, :3], axis=1)

    def between(self, since_s: float, until_s: float = np.inf) -> Flight:
        chosen = (self.time_s >= since_s) & (self.time_s < until_s)
        return Flight(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def asked_at_s(self, times_s: FloatArray) -> FloatArray:
        """When the last chunk had arrived that was carried out by each of these times, else NaN."""
        known = np.flatnonzero(np.isfinite(self.asked_s))
        at = np.searchsorted(self.time_s[known], times_s, side="right")
        return np.concatenate([[np.nan], self.asked_s[known]])[at]

    def longest_s(self, since_s: FloatArray) -> tuple[float, float] | None:
        """The longest it moved on after something.

        Args:
            since_s: (n,) when that had last happened, for each row; NaN is left out.

        Returns:
            How long, and when it had happened; None: it never moved after it.
        """
        late_s = np.where(self.speed_m_s > STILL_M_S, self.time_s - since_s, np.nan)
        if not np.isfinite(late_s).any():
            return None
        worst = int(np.nanargmax(late_s))
        return float(late_s[worst]), float(since_s[worst])

    def stood_at_s(self, since_s: float, until_s: float = np.inf) -> float | None:
        """When the arm first stood after `since_s`, for at least `STOOD_S`; None: it never did."""
        part = self.between(since_s, until_s)
        began_s: float | None = None
        for now_s, speed in zip(part.time_s.tolist(), part.speed_m_s.tolist(), strict=True):
            if speed > STILL_M_S:
                began_s = None
            elif began_s is None:
                began_s = now_s
            elif now_s - began_s >= STOOD_S:
                return began_s
        return None

    def moved_at_s(self, since_s: float, speed_m_s: float) -> float | None:
        """When it was first this fast after `since_s`."""
        part = self.between(since_s)
        fast = np.flatnonzero(part.speed_m_s > speed_m_s)
        return float(part.time_s[fast[0]]) if len(fast) else None

    def hardest_m_s2(self) -> float:
        """Largest change of velocity within `WINDOW_S`, per axis."""
        later = np.searchsorted(self.time_s, self.time_s + WINDOW_S)
        keep = later < len(self.time_s)
        if not keep.any():
            return 0.0
        first = np.flatnonzero(keep)
        apart_s = (self.time_s[later[keep]] - self.time_s[first])[:, None]
        change = np.abs(self.twist[later[keep], :3] - self.twist[first, :3]) / apart_s
        # Where rows are missing the mean over the hole would hide what happened in it.
        whole = apart_s[:, 0] < 2 * WINDOW_S
        return float(change[whole].max(initial=0.0))

    def jerk_m_s3(self, period_s: float) -> float:
        """Of a command stream: largest change of the acceleration, per axis."""
        step_s = np.round(np.diff(self.time_s) / period_s) * period_s
        inside = (step_s > 0) & (step_s < SLOWEST_S)
        if not inside.any():
            return 0.0
        jerk = np.diff(self.last, axis=0)[inside] / step_s[inside][:, None]
        return float(np.abs(jerk).max())


def read_flight(path: Path) -> Flight:
    """All rows of a file; what is half written at its end is left out."""
    numbers = np.frombuffer(path.read_bytes()[: path.stat().st_size // (8 * COLUMNS) * 8 * COLUMNS])
    rows = numbers.reshape(-1, COLUMNS)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return Flight(rows[:, 0], rows[:, 1:4], rows[:, 4:10], rows[:, 10:13], rows[:, 13], rows[:, 14])


def brake_s(profile: Profile, velocity_m_s: FloatArray, acceleration_m_s2: FloatArray) -> float:
    """How long Ruckig takes from this motion to rest, within the profile's limits."""
    period_s = 1.0 / profile.timing.command_hz
    smoother = Smoother(Pose(np.zeros(3), np.eye(3)), period_s, motion_limits(profile.limits))
    motion = smoother.motion
    smoother.brake_from(
        motion._replace(
            twist=np.concatenate([velocity_m_s, np.zeros(3)]),
            acceleration=np.concatenate([acceleration_m_s2, np.zeros(3)]),
        )
    )
    ticks = 0
    while not smoother.at_rest:
        smoother.tick()
        ticks += 1
    return ticks * period_s
