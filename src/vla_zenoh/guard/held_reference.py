"""Where the robot's own controller holds the arm when nothing is sent to it."""

from __future__ import annotations

import numpy as np

from vla_zenoh.guard.arm_guard import Measured
from vla_zenoh.kinematics.so3 import pose_distance

SETTLE_NS = 500_000_000
"""After the last command the arm comes to rest within this time."""
MOVED_M, MOVED_RAD = 0.005, 0.02
"""An arm at rest that is moved by more than this, TCP or any joint, is moved by somebody else: its
elbow may be, while the TCP stays."""


class HeldReference:
    """Remembers whether the last command sent still counts.

    A controller goes on holding what it was sent last, some way from where the arm is measured; the
    next stream has to begin there. When somebody else moves the arm that is no longer so. Times are
    of the monotonic clock.
    """

    def __init__(self) -> None:
        self._sent_ns: int | None = None
        self._settled: Measured | None = None

    @property
    def held(self) -> bool:
        """What was sent last is what the controller holds."""
        return self._sent_ns is not None

    def on_sent(self, now_ns: int) -> None:
        """A command was sent."""
        self._sent_ns, self._settled = now_ns, None

    def invalidate(self) -> None:
        """Nobody knows what became of the last commands: the robot is not heard."""
        self._sent_ns = self._settled = None

    def update(self, measured: Measured, now_ns: int) -> bool:
        """Whether `held` still; call it while nothing is sent."""
        if self._sent_ns is None or now_ns - self._sent_ns < SETTLE_NS:
            return self.held
        if self._settled is None:
            self._settled = measured
        apart_m, apart_rad = pose_distance(self._settled.pose, measured.pose)
        turned_rad = float(np.abs(measured.position_rad - self._settled.position_rad).max())
        if apart_m > MOVED_M or max(apart_rad, turned_rad) > MOVED_RAD:
            self.invalidate()
        return self.held
