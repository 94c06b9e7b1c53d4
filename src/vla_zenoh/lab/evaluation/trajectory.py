"""Lengths, angles and standstill of sampled paths, vectorised over rows."""

from __future__ import annotations

import numpy as np

from vla_zenoh.types import FloatArray

STILL_M_S, STILL_RAD_S = 0.002, 0.01
"""A slower arm counts as standing still."""


def known(rows: FloatArray) -> FloatArray:
    """Rows of finite numbers."""
    return rows[np.isfinite(rows).all(axis=1)] if len(rows) else rows


def path_m(position_m: FloatArray) -> float | None:
    """Length of the path through points (n, 3); incomplete points are left out."""
    points = known(position_m)
    if not len(points):
        return None
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def angles_rad(quat_xyzw: FloatArray, other_xyzw: FloatArray) -> FloatArray:
    """Angle of the shortest rotation between the orientations in each row, (n, 4) each."""
    turned = relative(quat_xyzw, other_xyzw)
    return 2.0 * np.arctan2(np.linalg.norm(turned[:, :3], axis=1), np.abs(turned[:, 3]))


def turned_rad(quat_xyzw: FloatArray) -> float | None:
    """Length of the path through orientations (n, 4) on geodesics; incomplete ones left out."""
    turns = known(quat_xyzw)
    if not len(turns):
        return None
    return float(angles_rad(turns[:-1], turns[1:]).sum())


def relative(quat_xyzw: FloatArray, other_xyzw: FloatArray) -> FloatArray:
    """Rotation from the first to the second orientation of each row, base axes."""
    v, w = -quat_xyzw[:, :3], quat_xyzw[:, 3:]
    u, s = other_xyzw[:, :3], other_xyzw[:, 3:]
    vector = s * v + w * u + np.cross(u, v)
    return np.hstack([vector, w * s - np.sum(u * v, axis=1, keepdims=True)])


def rotvecs(quat_xyzw: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3) in rad from the first known orientation, base axes."""
    found = known(quat_xyzw)
    if not len(found):
        return np.full((len(quat_xyzw), 3), np.nan)
    turned = relative(np.broadcast_to(found[:1], quat_xyzw.shape), quat_xyzw)
    turned = np.where(turned[:, 3:] < 0, -turned, turned)
    norm = np.linalg.norm(turned[:, :3], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, turned[:, 3:])
    return turned[:, :3] * np.where(norm > 1e-12, angle / np.maximum(norm, 1e-300), 2.0)


def idle_s(t_s: FloatArray, speed_m_s: FloatArray, turn_rad_s: FloatArray) -> float:
    """Time in which the arm stands still, of (n,) times and the (n - 1,) speeds between them."""
    still = (speed_m_s < STILL_M_S) & (turn_rad_s < STILL_RAD_S)
    return float(np.diff(t_s)[still].sum())
