"""Poses and rotations: Pinocchio's exp and log with the few helpers this package needs.

Pinocchio is imported where it is called: a model's environment has none, and reads poses there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.policy.meaning import quat_of_matrix
from vla_zenoh.types import FloatArray, PoseState

MEAN_ITERATIONS = 10
MEAN_RAD = 1e-10
"""The mean of rotations has converged when it moves by less."""


class Pose(NamedTuple):
    """A pose in the base frame: position (3,) in m and rotation matrix (3, 3)."""

    position_m: FloatArray
    rotation: FloatArray


def exp3(rotvec: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (rad)."""
    import pinocchio as pin

    return pin.exp3(np.asarray(rotvec, dtype=np.float64))


def log3(rotation: FloatArray) -> FloatArray:
    """Rotation vector (rad) of a rotation matrix, angle within [0, pi]."""
    import pinocchio as pin

    return pin.log3(np.asarray(rotation, dtype=np.float64))


def rotation_from_rpy(rpy: FloatArray) -> FloatArray:
    """Extrinsic x, y, z: ``R = Rz(yaw) Ry(pitch) Rx(roll)``."""
    import pinocchio as pin

    return pin.rpy.rpyToMatrix(float(rpy[0]), float(rpy[1]), float(rpy[2]))


def rotation_from_quat(quat_xyzw: FloatArray) -> FloatArray:
    """Rotation matrix of a quaternion x, y, z, w, which is normalised first."""
    # Plain floats: this runs in every tick, and Pinocchio's quaternions cost twice as much.
    x, y, z, w = quat_xyzw.tolist()
    double = 2.0 / (x * x + y * y + z * z + w * w)
    xs, ys, zs = x * double, y * double, z * double
    xx, yy, zz, xy, xz, yz = x * xs, y * ys, z * zs, x * ys, x * zs, y * zs
    xw, yw, zw = w * xs, w * ys, w * zs
    return np.array(
        (
            (1.0 - yy - zz, xy - zw, xz + yw),
            (xy + zw, 1.0 - xx - zz, yz - xw),
            (xz - yw, yz + xw, 1.0 - xx - yy),
        )
    )


def quat_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternion x, y, z, w with w >= 0."""
    return np.array(quat_of_matrix(rotation.tolist()))


def orthonormal(rotation: FloatArray) -> FloatArray:
    """A product of many rotation matrices, without its rounding errors."""
    return rotation_from_quat(quat_from_rotation(rotation))


def norm3(vector: FloatArray) -> float:
    """Length of a vector (3,); `numpy.linalg.norm` costs five times as much."""
    return math.hypot(*vector.tolist())


def cross3(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of vectors (3,); `numpy.cross` costs ten times as much."""
    return np.array(_cross(a.tolist(), b.tolist()))


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Geodesic distance of two rotation matrices in rad."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (b @ a.T).tolist()
    return math.atan2(math.hypot(zy - yz, xz - zx, yx - xy), xx + yy + zz - 1.0)


def pose_distance(a: Pose, b: Pose) -> tuple[float, float]:
    """How far two poses are apart: m and rad."""
    return norm3(a.position_m - b.position_m), angle_between(a.rotation, b.rotation)


def pose_of(measured: PoseState) -> Pose:
    """The pose of a measured state."""
    return Pose(measured.position_m, rotation_from_quat(measured.quat_xyzw))


def held_pose(measured: PoseState) -> Pose:
    """Set-point of the robot's controller, if the robot reports it; else the measured pose."""
    if measured.reference_position_m is None or measured.reference_quat_xyzw is None:
        return pose_of(measured)
    return Pose(measured.reference_position_m, rotation_from_quat(measured.reference_quat_xyzw))


def interpolate(start: Pose, end: Pose, share: float) -> Pose:
    """The pose at `share` (0 to 1) of the way: a straight line and the shortest turn."""
    turn = log3(end.rotation @ start.rotation.T)
    return Pose(
        start.position_m + share * (end.position_m - start.position_m),
        orthonormal(exp3(share * turn) @ start.rotation),
    )


def mean_pose(poses: Sequence[Pose], weights: FloatArray) -> Pose:
    """Weighted mean of poses: in R^3, and on SO(3), where ``sum_i w_i log(R_i R^T) = 0``.

    Iterated from the last rotation (Karcher).

    Args:
        poses: rotations less than half a turn apart.
        weights: (n,) not negative, not all zero.
    """
    shares = weights / weights.sum()
    position_m = shares @ np.array([pose.position_m for pose in poses])
    rotation = poses[-1].rotation
    for _ in range(MEAN_ITERATIONS):
        turn = shares @ np.array([log3(pose.rotation @ rotation.T) for pose in poses])
        rotation = exp3(turn) @ rotation
        if norm3(turn) < MEAN_RAD:
            break
    return Pose(position_m, orthonormal(rotation))


def _coefficients(squared: float) -> tuple[float, float, float, float]:
    """Of ``t^2``: ``B = (1 - cos t)/t^2``, ``C = (t - sin t)/t^3``, ``B'/t`` and ``C'/t``."""
    angle = math.sqrt(squared)
    if angle < 1e-3:  # series: the closed forms lose all digits here
        return 0.5 - squared / 24, 1 / 6 - squared / 120, -1 / 12, -1 / 60
    sine, cosine = math.sin(angle), math.cos(angle)
    return (
        (1 - cosine) / squared,
        (angle - sine) / (squared * angle),
        (angle * sine - 2 * (1 - cosine)) / squared**2,
        ((1 - cosine) * angle - 3 * (angle - sine)) / (squared**2 * angle),
    )


def spatial_rates(
    rotvec: FloatArray, rate: FloatArray, rate_change: FloatArray, side: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Angular velocity and acceleration of ``exp3(r(t)) R0`` in the fixed axes.

    With the left Jacobian ``Jl(r) = I + B [r] + C [r]^2``, ``B = (1 - cos t)/t^2``,
    ``C = (t - sin t)/t^3``, ``t = |r|``::

        w     = Jl r'
        alpha = Jl r'' + Jl' r'
        Jl'r' = B' [r]r' + C' [r][r]r' + C [r'][r]r'

    Closed form, because finite differences of Jl show as spikes in the jerk; written out, because
    it runs in every tick. r is in rad; all are (3,). A `side` of -1, the sign of B, gives those of
    ``exp3(r(t))`` in its own axes: its right Jacobian is ``Jr(r) = Jl(-r)``.

    Source: Sola, Deray, Atchuthan, "A micro Lie theory", 2018, eq. 145, differentiated.
    """
    r, r1, r2 = rotvec.tolist(), rate.tolist(), rate_change.tolist()
    squared = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    along = r[0] * r1[0] + r[1] * r1[1] + r[2] * r1[2]
    b, c, b_rate, c_rate = _coefficients(squared)
    b, b_rate, c_rate = side * b, side * b_rate * along, c_rate * along
    # [a][b]x = b (a . x) - x (a . b) leaves two cross products.
    p, s = _cross(r, r1), _cross(r, r2)
    bends = r1[0] * r1[0] + r1[1] * r1[1] + r1[2] * r1[2]
    bends += r[0] * r2[0] + r[1] * r2[1] + r[2] * r2[2]
    own, of_r, of_r1 = 1.0 - c * squared, c * bends + c_rate * along, c_rate * squared + c * along
    velocity = [own * r1[i] + b * p[i] + c * along * r[i] for i in range(3)]
    acceleration = [
        own * r2[i] + b * s[i] + b_rate * p[i] + of_r * r[i] - of_r1 * r1[i] for i in range(3)
    ]
    return np.array(velocity), np.array(acceleration)


def rates_of(
    rotvec: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The inverse of `spatial_rates`: r' and r'' of velocity and acceleration in the fixed axes.

    With ``Jl^-1(r) = I - [r]/2 + D [r]^2``, ``D = 1/t^2 - (1 + cos t)/(2 t sin t)``, ``t = |r|``,
    which is below pi.

    Source: Sola, Deray, Atchuthan, "A micro Lie theory", 2018, eq. 146.
    """
    angle = norm3(rotvec)
    if angle < 1e-2:
        d = 1 / 12 + angle * angle / 720
    else:
        d = 1 / angle**2 - (1 + math.cos(angle)) / (2 * angle * math.sin(angle))
    r = rotvec.tolist()

    def inverse(of: Sequence[float]) -> FloatArray:
        p = _cross(r, of)
        q = _cross(r, p)
        return np.array([of[i] - 0.5 * p[i] + d * q[i] for i in range(3)])

    rate = inverse(velocity.tolist())
    _, of_rate = spatial_rates(rotvec, rate, np.zeros(3))
    return rate, inverse((acceleration - of_rate).tolist())
