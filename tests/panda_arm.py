"""The Panda of the shipped profiles, for tests of its kinematics."""

from __future__ import annotations

import numpy as np

from vla_zenoh.kinematics.kinematics import InverseKinematics, Kinematics, pose_error
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.resources import robot_urdf
from vla_zenoh.types import FloatArray

URDF = robot_urdf("example-robot-data:panda_description/urdf/panda.urdf")
TCP_FRAME = "panda_hand_tcp"
ARM_JOINTS = tuple(f"panda_joint{index}" for index in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
HOME_RAD = np.array([0.0, -0.0439564754, 0.0, -2.6269994397, 0.0, 2.5830429643, 0.7853981634])
"""TCP at (0.43, 0, 0.16) m, tool straight down."""


def panda() -> Kinematics:
    return Kinematics(URDF, TCP_FRAME, ARM_JOINTS, FINGER_JOINTS, base_frame="panda_link0")


def tool_down_at(kinematics: Kinematics, *position_m: float) -> FloatArray:
    """Joints that put the TCP at `position_m`, tool down, on the straight way from home."""
    solver = InverseKinematics(kinematics, HOME_RAD)
    home, joints = kinematics.forward(HOME_RAD), HOME_RAD
    for share in np.linspace(0, 1, 21):
        place = home.position_m + share * (np.array(position_m) - home.position_m)
        found = solver.approach(Pose(place, home.rotation), joints)
        assert found.solved
        joints = found.joints_rad
    return joints


def moved(pose: Pose, translation_m: FloatArray, rotvec_rad: FloatArray) -> Pose:
    """`pose` after a delta in the base frame."""
    return Pose(
        pose.position_m + np.asarray(translation_m, float),
        exp3(np.asarray(rotvec_rad, float)) @ pose.rotation,
    )


def swivelled(kinematics: Kinematics, swivel: float) -> FloatArray:
    """Joints with the TCP of home, and the elbow turned about it by a motion of the null space."""
    joints, home = HOME_RAD.copy(), kinematics.forward(HOME_RAD)
    for _ in range(400):
        pose, jacobian = kinematics.pose_and_jacobian(joints)
        _, _, rows = np.linalg.svd(jacobian)
        null = rows[-1] * np.sign(rows[-1][0])
        back = np.linalg.lstsq(jacobian, pose_error(home, pose), rcond=None)[0]
        joints = joints + back + null * (swivel / 400)
    return joints
