"""Measured poses of the last seconds: where the arm was when an observation was taken."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque

from vla_zenoh.kinematics.so3 import Pose, interpolate, pose_of
from vla_zenoh.types import PoseState, Stamped

KEPT_NS = 2_500_000_000
"""Longer than any observation that is not rejected as stale by default."""
MOST = 2500
"""Of a robot that publishes its state at up to 1 kHz all are kept."""


class PoseHistory:
    """Poses by the time they were measured."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=MOST)
        self._poses: deque[PoseState] = deque(maxlen=MOST)

    def add(self, measured: Stamped[PoseState]) -> None:
        """Keep a pose, unless it was measured before the last one."""
        stamp_ns = measured.header.stamp_wall_ns
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._poses.append(measured.record)
        while self._stamps[0] < stamp_ns - KEPT_NS:
            self._stamps.popleft()
            self._poses.popleft()

    def at(self, t_ns: int, gap_ns: int) -> Pose | None:
        """The pose at `t_ns`, between the two measured next to it, or the last one before it.

        Args:
            t_ns: on the clock of the stamps.
            gap_ns: a pose measured longer before than this says nothing of `t_ns`.

        Returns:
            None where no pose was measured within `gap_ns` before.
        """
        index = bisect_right(self._stamps, t_ns)
        if index == 0 or t_ns - self._stamps[index - 1] > gap_ns:
            return None
        before = pose_of(self._poses[index - 1])
        if index == len(self._stamps) or self._stamps[index - 1] == t_ns:
            return before
        since_ns, until_ns = self._stamps[index - 1], self._stamps[index]
        share = (t_ns - since_ns) / (until_ns - since_ns)
        return interpolate(before, pose_of(self._poses[index]), share)
