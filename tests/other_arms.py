"""Arms of five and six joints, by descriptions that come with a package."""

from __future__ import annotations

from typing import Any

from vla_zenoh.profile import Profile, load_profile, override

SO101: dict[str, Any] = {
    "name": "so101",
    "command": "joint",
    "description": "shipped:so101.urdf",
    "base_frame": "base_link",
    "tcp_frame": "gripper_frame_link",
    "arm_joints": ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"],
    "finger_joints": ["gripper"],
    "home_rad": [0.0, -0.6, 0.6, 0.8, 0.0],
    "gripper": {"joint_open_rad": 1.7, "joint_shut_rad": -0.17},
}
UR5: dict[str, Any] = {
    "name": "ur5",
    "command": "joint",
    "description": "example-robot-data:ur_description/urdf/ur5_joint_limited_robot.urdf",
    "base_frame": "base_link",
    "tcp_frame": "tool0",
    "arm_joints": [
        *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
        *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
    ],
    "finger_joints": [],
    "gripper": None,
    "home_rad": [0.0, -1.57, 1.57, -1.57, -1.57, 0.0],
}


def so101(command: str = "joint") -> Profile:
    """Five joints, one of which rolls the wrist."""
    limits = {
        "workspace": {"x_m": [0.0, 0.5], "y_m": [-0.4, 0.4], "z_m": [0.01, 0.5]},
        "joint": {"velocity_rad_s": 1.5, "acceleration_rad_s2": 6.0, "jerk_rad_s3": 200.0},
        "step_rad": 0.6,
        "step_m": 0.1,
    }
    return _arm({**SO101, "command": command}, limits)


def ur5(command: str = "joint") -> Profile:
    """Six joints."""
    limits = {
        "workspace": {"x_m": [0.1, 0.8], "y_m": [-0.5, 0.5], "z_m": [0.012, 0.8]},
        "joint": {"velocity_rad_s": 1.5, "acceleration_rad_s2": 4.0, "jerk_rad_s3": 200.0},
    }
    return _arm({**UR5, "command": command}, limits)


def _arm(robot: dict[str, Any], limits: dict[str, Any]) -> Profile:
    return override(load_profile("panda_sim"), {"robot": robot, "limits": limits})
