"""Positions of finger joints and the opening of a gripper.

Sliding fingers add up to the opening, unless the profile gives their positions when open and shut;
revolute fingers need these. Several joints move alike, as those of one motor do, or as mirror
images: then `Kinematics.finger_signs` has -1 for those that go the other way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.profile import GripperProfile


class Fingers:
    """Converts between the opening of a gripper and the positions of its finger joints.

    Args:
        gripper: its section of the profile.
        count: number of finger joints; 0: one that is commanded and not measured.

    Attributes:
        slope: m of opening per m or rad of their mean position.
    """

    def __init__(self, gripper: GripperProfile, count: int) -> None:
        self._count = max(count, 1)
        ends = gripper.joint_ends
        # width = slope * mean position + offset
        if ends is None:
            self.slope, self._offset_m = float(self._count), 0.0
        else:
            self.slope = gripper.max_width_m / (ends.open - ends.shut)
            self._offset_m = -self.slope * ends.shut

    def width_m(self, positions: ArrayLike) -> float:
        """Opening at the measured positions (k,), m or rad, each with its finger's sign."""
        return self.slope * float(np.asarray(positions, np.float64).mean()) + self._offset_m

    def speed_m_s(self, velocities: ArrayLike) -> float:
        """Speed of the opening at joint velocities (k,), m/s or rad/s, with their signs."""
        return abs(self.slope * float(np.asarray(velocities, np.float64).mean()))

    def position(self, width_m: float) -> float:
        """Position of each joint at an opening, m or rad, to be multiplied by its sign."""
        return (width_m - self._offset_m) / self.slope
