"""Motion during each prompt: along the requested axis, and off it."""

from __future__ import annotations

import numpy as np

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.demo.scripted_motions import ScriptedPrompt, parse_scripted
from vla_zenoh.lab.evaluation.result import PromptSegment
from vla_zenoh.types import FloatArray

STILL_M_S, STILL_RAD_S = 0.002, 0.01
"""A slower arm counts as standing still."""


def known(rows: FloatArray) -> FloatArray:
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


def segment(
    prompt: str,
    requests: int,
    seconds: float,
    position_m: FloatArray,
    quat_xyzw: FloatArray,
    width_m: FloatArray,
) -> PromptSegment:
    """The segment of one prompt.

    Args:
        prompt: as published; the motion that HARD ones request is known.
        requests: steps executed.
        seconds: duration.
        position_m: (n, 3), may hold NaN.
        quat_xyzw: (n, 4), may hold NaN.
        width_m: (m,) gripper opening, may hold NaN.
    """
    moved, turned = _since_first(position_m), rotvecs(quat_xyzw)
    asked = _asked(prompt)
    axis = None if asked is None or asked.motion is None else asked.motion.axis
    steps = requests if asked is None or asked.steps is None else min(requests, asked.steps)
    amount = None if asked is None else asked.offset(steps)
    along_m, drift_m = _split(moved, axis if axis in (0, 1, 2) else None, amount)
    about = axis - 3 if axis in (3, 4, 5) else None
    along_rad, drift_rad = _split(turned, about, amount)
    widths = width_m[np.isfinite(width_m)]
    return PromptSegment(
        prompt,
        requests,
        seconds,
        path_m(position_m),
        turned_rad(quat_xyzw),
        _last(moved),
        _last(turned),
        None if asked is None or amount is None else abs(amount) if axis in (0, 1, 2) else 0.0,
        None if asked is None or amount is None else abs(amount) if about is not None else 0.0,
        along_m if asked is not None else None,
        along_rad if asked is not None else None,
        drift_m if asked is not None else None,
        drift_rad if asked is not None else None,
        (float(widths[0]), float(widths[-1])) if len(widths) else None,
    )


def _asked(prompt: str) -> ScriptedPrompt | None:
    try:
        return parse_scripted(prompt)
    except SpecError:
        return None


def _since_first(position_m: FloatArray) -> FloatArray:
    there = np.isfinite(position_m).all(axis=1)
    if not there.any():
        return np.full_like(position_m, np.nan)
    return position_m - position_m[np.argmax(there)]


def _last(rows: FloatArray) -> tuple[float, ...]:
    there = rows[np.isfinite(rows).all(axis=1)]
    return tuple(float(value) for value in there[-1]) if len(there) else ()


def _split(
    moved: FloatArray, axis: int | None, amount: float | None
) -> tuple[float | None, float | None]:
    """Final displacement along the axis, and the largest one off it."""
    there = moved[np.isfinite(moved).all(axis=1)]
    if not len(there):
        return None, None
    if axis is None:
        return 0.0, float(np.linalg.norm(there, axis=1).max())
    off = np.delete(there, axis, axis=1)
    sign = -1.0 if amount is not None and amount < 0 else 1.0
    return sign * float(there[-1, axis]), float(np.linalg.norm(off, axis=1).max())
