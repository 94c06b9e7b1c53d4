"""Joint positions to poses of the TCP, for policies that speak of joints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.profile import Profile
from vla_zenoh.types import JointState

Forward = Callable[[JointState, NDArray[np.float64]], NDArray[np.float64]]
"""Measured joints and (H, n) joint positions in their order -> (H, 7) position and quat_xyzw."""


def make_forward(profile: Profile) -> Forward:
    """Forward kinematics of the profile's arm.

    Raises:
        MissingExtraError: Pinocchio is not installed.
        ResourceError: the robot's description is not there.
        ProfileError: frames or joints that the description does not have.
    """
    try:
        from vla_zenoh.kinematics.kinematics import make_kinematics
    except ImportError as error:
        raise MissingExtraError(error.name or "pinocchio", "control") from error
    kinematics = make_kinematics(profile)

    def forward(measured: JointState, joints_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = [kinematics.forward(kinematics.ordered(measured.names, row)) for row in joints_rad]
        return np.array([[*pose.position_m, *quat_from_rotation(pose.rotation)] for pose in poses])

    return forward


def poses_of(
    rows_rad: NDArray[np.float64], measured: JointState, forward: Forward, *, deltas: bool
) -> NDArray[np.float64]:
    """(H, 7) position and quat_xyzw of the TCP.

    Args:
        rows_rad: (H, n) joints of each step, in the order of the measured ones.
        measured: where the arm was when it was looked at.
        forward: kinematics of the arm.
        deltas: each row is added to the one before, the first to the measured joints.
    """
    if deltas:
        rows_rad = measured.position_rad + np.cumsum(rows_rad, axis=0)
    return forward(measured, rows_rad)
