"""Kinematics that Franka publishes, the same for Panda and FR3.

Source: "Robot and interface specifications" of the Franka Control Interface documentation.
"""

from __future__ import annotations

import math

import numpy as np

from vla_zenoh.types import FloatArray

_TURN = math.pi / 2
CRAIG = (
    # a (m), d (m), alpha (rad)
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -_TURN),
    (0.0, 0.316, _TURN),
    (0.0825, 0.0, _TURN),
    (-0.0825, 0.384, -_TURN),
    (0.0, 0.0, _TURN),
    (0.088, 0.0, _TURN),
)
"""Denavit-Hartenberg parameters of joint 1 to 7, in Craig's convention."""
FLANGE_M = 0.107
"""From the frame of joint 7 to the flange, along z."""


def flange_pose(position_rad: FloatArray) -> FloatArray:
    """(4, 4): the flange in the base frame, with the joints at `position_rad` (7,)."""
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(CRAIG, position_rad, strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, a],
                [st * ca, ct * ca, -sa, -d * sa],
                [st * sa, ct * sa, ca, d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    pose[:3, 3] += FLANGE_M * pose[:3, 2]
    return pose
