"""Kinematics of a Franka Panda by its published Denavit-Hartenberg parameters, in numpy alone.

For programs that run in ROS's own Python, where nothing of this package is. The tool is the hand
that the arm comes with: TCP 0.1034 m before the flange, turned by -45 degrees.
"""

from __future__ import annotations

import numpy as np

PI_2 = np.pi / 2
# (a m, d m, alpha rad), Craig's convention: base to link 7.
LINKS = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -PI_2),
    (0.0, 0.316, PI_2),
    (0.0825, 0.0, PI_2),
    (-0.0825, 0.384, -PI_2),
    (0.0, 0.0, PI_2),
    (0.088, 0.0, PI_2),
)
FLANGE_M, TCP_M = 0.107, 0.1034
HOME_RAD = (0.0, -0.0439564754, 0.0, -2.6269994397, 0.0, 2.5830429643, 0.7853981634)
JOINTS = tuple(f"panda_joint{index}" for index in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


def _joint(a_m, d_m, alpha_rad, angle_rad):
    c, s, ca, sa = np.cos(angle_rad), np.sin(angle_rad), np.cos(alpha_rad), np.sin(alpha_rad)
    return np.array(
        [
            [c, -s, 0.0, a_m],
            [s * ca, c * ca, -sa, -sa * d_m],
            [s * sa, c * sa, ca, ca * d_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


TOOL = _joint(0.0, FLANGE_M, 0.0, -np.pi / 4) @ _joint(0.0, TCP_M, 0.0, 0.0)


def frames(q_rad):
    """Pose of each joint's frame and of the TCP in the base: eight (4, 4) matrices."""
    pose, out = np.eye(4), []
    for (a_m, d_m, alpha_rad), angle_rad in zip(LINKS, q_rad, strict=True):
        pose = pose @ _joint(a_m, d_m, alpha_rad, angle_rad)
        out.append(pose)
    return [*out, pose @ TOOL]


def forward(q_rad):
    """Pose of the TCP in the base, (4, 4)."""
    return frames(q_rad)[-1]


def pose_and_jacobian(q_rad):
    """Pose of the TCP, and its (6, 7) Jacobian: linear, then angular, axes of the base."""
    *joints, tcp = frames(q_rad)
    axes = np.array([joint[:3, 2] for joint in joints])
    arms = np.array([tcp[:3, 3] - joint[:3, 3] for joint in joints])
    return tcp, np.vstack((np.cross(axes, arms).T, axes.T))


def rotation_of(quat_xyzw):
    """(3, 3) of a quaternion."""
    x, y, z, w = np.asarray(quat_xyzw) / np.linalg.norm(quat_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_of(rotation):
    """Quaternion (x, y, z, w) of a (3, 3)."""
    w = np.sqrt(max(0.0, 1 + np.trace(rotation))) / 2
    if w > 0.1:
        low = rotation - rotation.T
        return np.array([low[2, 1], low[0, 2], low[1, 0], 4 * w * w]) / (4 * w)
    k = int(np.argmax(np.diag(rotation)))
    i, j = (k + 1) % 3, (k + 2) % 3
    out = np.zeros(4)
    out[k] = np.sqrt(max(0.0, 1 + 2 * rotation[k, k] - np.trace(rotation))) / 2
    out[i] = (rotation[k, i] + rotation[i, k]) / (4 * out[k])
    out[j] = (rotation[k, j] + rotation[j, k]) / (4 * out[k])
    out[3] = (rotation[j, i] - rotation[i, j]) / (4 * out[k])
    return out


def turn_between(goal, here):
    """Rotation vector from `here` to `goal`, axes of the base; both (3, 3)."""
    x, y, z, w = quat_of(goal @ here.T)
    vector = np.array([x, y, z])
    sine = np.linalg.norm(vector)
    if sine < 1e-12:
        return np.zeros(3)
    return 2 * np.arctan2(sine, w) * vector / sine


def turned(rotation, vector_rad):
    """A rotation turned by a rotation vector in the axes of the base."""
    angle_rad = np.linalg.norm(vector_rad)
    if angle_rad < 1e-12:
        return rotation
    half = angle_rad / 2
    quat = np.append(np.sin(half) * vector_rad / angle_rad, np.cos(half))
    return rotation_of(quat) @ rotation


def inverse(position_m, rotation, near_rad, rounds=8):
    """Joints (7,) of a pose near others, by damped least squares; as near as it gets."""
    q_rad = np.array(near_rad, float)
    for _ in range(rounds):
        tcp, jacobian = pose_and_jacobian(q_rad)
        error = np.concatenate((position_m - tcp[:3, 3], turn_between(rotation, tcp[:3, :3])))
        if np.abs(error).max() < 1e-10:
            break
        square = jacobian @ jacobian.T + 1e-8 * np.eye(6)
        q_rad += jacobian.T @ np.linalg.solve(square, error)
    return q_rad
