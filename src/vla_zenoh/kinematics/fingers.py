"""From the joints of the fingers to the opening between them, and back, in a straight line.

Fingers that slide add up to the opening, unless the profile says at which of their positions the
gripper is open and shut; fingers that turn need that. Where several joints are named they are told
and moved alike, as those of one motor are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.profile import GripperProfile


class Fingers:
    """Converts between the opening of a gripper and the positions of its finger joints.

    Args:
        gripper: its section of the profile.
        count: how many finger joints there are; 0: one that is commanded and not told.
    """

    def __init__(self, gripper: GripperProfile, count: int) -> None:
        self._count = max(count, 1)
        ends = gripper.joint_ends
        # width = slope * mean position + offset
        if ends is None:
            self._slope, self._offset_m = float(self._count), 0.0
        else:
            self._slope = gripper.max_width_m / (ends.open - ends.shut)
            self._offset_m = -self._slope * ends.shut

    def width_m(self, positions: ArrayLike) -> float:
        """Opening, of the positions (k,) m or rad of those joints that are told."""
        return self._slope * float(np.asarray(positions, np.float64).mean()) + self._offset_m

    def speed_m_s(self, velocities: ArrayLike) -> float:
        """How fast it changes, of their velocities (k,) m/s or rad/s."""
        return abs(self._slope * float(np.asarray(velocities, np.float64).mean()))

    def position(self, width_m: float) -> float:
        """Where each joint is at an opening, m or rad."""
        return (width_m - self._offset_m) / self._slope
