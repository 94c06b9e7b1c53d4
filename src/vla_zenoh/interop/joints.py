"""Joint positions to poses of the TCP, for policies that speak of joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.so3 import quat_from_rotation
from vla_zenoh.errors import MissingExtraError
from vla_zenoh.interop.layout import Forward
from vla_zenoh.profile import Profile
from vla_zenoh.types import JointState


def make_forward(profile: Profile) -> Forward:
    """Forward kinematics of the profile's arm.

    Raises:
        MissingExtraError: Pinocchio is not installed.
        ResourceError: the robot's description is not there.
        ProfileError: frames or joints that the description does not have.
    """
    try:
        from vla_zenoh.control.arm import make_kinematics
    except ImportError as error:
        raise MissingExtraError(error.name or "pinocchio", "control") from error
    kinematics = make_kinematics(profile)

    def forward(measured: JointState, joints_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = [kinematics.forward(kinematics.ordered(measured.names, row)) for row in joints_rad]
        return np.array([[*pose.position_m, *quat_from_rotation(pose.rotation)] for pose in poses])

    return forward
