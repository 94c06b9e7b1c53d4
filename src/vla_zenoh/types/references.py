"""Set-points of an arm's controller: where it has to be now, and how it moves there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.types.checks import FloatArray


class PoseReference(NamedTuple):
    """Where the TCP has to be now, in the base frame, and how it moves there.

    Args:
        position_m: (3,).
        rotation: (3, 3), columns are the TCP's axes.
        twist: (6,) m/s and rad/s.
        acceleration: (6,) m/s^2 and rad/s^2.
    """

    position_m: FloatArray
    rotation: FloatArray
    twist: FloatArray
    acceleration: FloatArray


class JointReference(NamedTuple):
    """Where the joints have to be now, in the order along the arm.

    Args:
        position_rad: (n,).
        velocity_rad_s: (n,).
        acceleration_rad_s2: (n,).
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray

    @classmethod
    def at_rest(cls, position_rad: FloatArray) -> JointReference:
        """Standing at `position_rad`, of which it keeps a copy."""
        zeros = np.zeros(len(position_rad))
        return cls(np.array(position_rad, float), zeros, zeros)
