"""Motion during each prompt: along the requested axis, and off it."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.demo.scripted_motions import parse_scripted
from vla_zenoh.lab.evaluation.result import PromptSegment
from vla_zenoh.types import FloatArray

STILL_M_S, STILL_RAD_S = 0.002, 0.01
"""A slower arm counts as standing still."""


def known(rows: FloatArray) -> FloatArray:
    """The rows (n, D) without NaN."""
    return rows[np.isfinite(rows).all(axis=1)]


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


def segment(
    prompt: str,
    requests: int,
    seconds: float,
    position_m: FloatArray,
    quat_xyzw: FloatArray,
    width_m: FloatArray,
    limits: tuple[str, ...] = (),
) -> PromptSegment:
    """The segment of one prompt.

    Args:
        prompt: as published; the motion that HARD ones request is known.
        position_m: (n, 3), may hold NaN.
        quat_xyzw: (n, 4), may hold NaN.
        width_m: (m,) gripper opening, may hold NaN.
        limits: that acted.
    """
    moved, turned = known(position_m), rotvecs(known(quat_xyzw))
    moved = moved - moved[:1]
    way: tuple[float | None, float | None, float | None] = (None, None, None)
    turn = way
    with suppress(SpecError):
        asked = parse_scripted(prompt)
        amount = asked.offset(requests if asked.steps is None else min(requests, asked.steps))
        axis = -1 if asked.motion is None else asked.motion.axis
        way, turn = _compared(moved, axis, amount), _compared(turned, axis - 3, amount)
    widths = width_m[np.isfinite(width_m)]
    return PromptSegment(
        prompt,
        requests,
        seconds,
        path_m(position_m),
        turned_rad(quat_xyzw),
        tuple(moved[-1].tolist()) if len(moved) else (),
        tuple(turned[-1].tolist()) if len(turned) else (),
        *(way[0], turn[0], way[1], turn[1], way[2], turn[2]),
        (float(widths[0]), float(widths[-1])) if len(widths) else None,
        limits,
    )


def _compared(
    moved: FloatArray, axis: int, amount: float
) -> tuple[float, float | None, float | None]:
    """Asked along an axis, reached along it, and furthest off it; any other than x, y, z: none."""
    on_axis = axis in (0, 1, 2)
    asked = abs(amount) if on_axis else 0.0
    if not len(moved):
        return asked, None, None
    off = np.linalg.norm(np.delete(moved, axis, axis=1) if on_axis else moved, axis=1)
    reached = float(moved[-1, axis]) * (-1.0 if amount < 0 else 1.0) if on_axis else 0.0
    return asked, reached, float(off.max())
