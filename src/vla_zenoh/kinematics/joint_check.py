"""Whether the joints heard are those of the robot described, and where they are held."""

from __future__ import annotations

import numpy as np

from vla_zenoh.errors import VlaZenohError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import held_pose, pose_distance, pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import JointState, PoseState, Stamped

JOINT_PATIENCE_S = 0.1
SAME_TCP_M, SAME_TCP_RAD = 0.005, 0.02
"""Kinematics and the robot's own word on its TCP may differ by this much."""
HELD_RAD = 0.1
"""A joint may be so far from where its controller holds it."""


def joint_state_faults(
    profile: Profile,
    kinematics: Kinematics,
    joint: Stamped[JointState] | None,
    pose: Stamped[PoseState],
    now_ns: int,
) -> list[str]:
    """Whether the kinematics know this robot: joints heard, and their TCP where it is said to be.

    Args:
        profile: the effective profile.
        kinematics: of the robot it describes.
        joint: newest joint state.
        pose: newest TCP pose.
        now_ns: same clock as the records' ``received_ns``.
    """
    if joint is None:
        return ["the joints are not known: nothing was heard on state/joint"]
    age_s = (now_ns - joint.received_ns) / 1e9
    if age_s > profile.timing.state_timeout_s + JOINT_PATIENCE_S:
        return [f"the joint state is {age_s:.2f} s old"]
    try:
        joints_rad = kinematics.joints_of(joint.record)
    except VlaZenohError as error:
        return [str(error)]
    apart_m, apart_rad = pose_distance(kinematics.forward(joints_rad), pose_of(pose.record))
    if apart_m <= SAME_TCP_M and apart_rad <= SAME_TCP_RAD:
        return _elbow_is_not_held(profile, joint.record, pose.record)
    return [
        f"the joints put the TCP {apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad from where "
        "the robot says it is: robot.description or robot.tcp_frame is another robot's"
    ]


def _elbow_is_not_held(profile: Profile, joint: JointState, pose: PoseState) -> list[str]:
    """Whether joints that are to be commanded begin far from where they are.

    They begin where the robot's controller holds them. A TCP that is far from there is blocked and
    led back, with all its joints; where it is not, the elbow was moved by itself, and would be
    pulled to where it once was.
    """
    if profile.robot.command != "joint" or joint.reference_rad is None:
        return []
    apart_m, apart_rad = pose_distance(held_pose(pose), pose_of(pose))
    if apart_m > profile.limits.tracking_m or apart_rad > profile.limits.tracking_rad:
        return []
    away_rad = np.abs(joint.reference_rad - joint.position_rad)
    worst = int(np.argmax(away_rad))
    if float(away_rad[worst]) <= HELD_RAD:
        return []
    return [
        f"joint {joint.names[worst]} is {away_rad[worst]:.2f} rad from where its controller holds "
        f"it, at most {HELD_RAD:g}: let go of the arm, or move the robot by its own means once"
    ]
