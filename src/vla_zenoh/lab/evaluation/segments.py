"""Motion during each prompt: along the requested axis, and off it."""

from __future__ import annotations

import numpy as np

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.demo.scripted_motions import ScriptedPrompt, parse_scripted
from vla_zenoh.lab.evaluation.result import PromptSegment
from vla_zenoh.lab.evaluation.trajectory import path_m, rotvecs, turned_rad
from vla_zenoh.types import FloatArray


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
