"""Numbers that a policy was trained on, back as a robot's state."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.policy_servers.state_vector import JOINTS, Numbers, size_of


def state_of(
    names: Sequence[str], numbers: NDArray[np.float64], joints: int, max_width_m: float
) -> dict[str, Any]:
    """The other way round: what the numbers say of the robot.

    Args:
        names: of `read_parts`; single coordinates (``x``, ``roll``) are not read back.
        numbers: (n,).
        joints: how many the arm has.
        max_width_m: of the open gripper.

    Returns:
        any of ``joint`` (n,) rad, ``position_m`` (3,), ``quat_xyzw`` (4,), ``width_m``.

    Raises:
        SpecError: another count of numbers, or a part that cannot be read back.
    """
    sizes = [size_of(name, joints) for name in names]
    if numbers.shape != (sum(sizes),):
        raise SpecError(
            f"{'+'.join(names)} has shape {numbers.shape}, wanted ({sum(sizes)},)", "shape"
        )
    out: dict[str, Any] = {}
    at = 0
    for name, size in zip(names, sizes, strict=True):
        values, at = numbers[at : at + size], at + size
        if name in JOINTS:
            out["joint"] = values if name == "joint" else np.deg2rad(values)
        elif name == "position":
            out["position_m"] = values
        elif name in _ROTATIONS_BACK:
            out["quat_xyzw"] = np.array(_ROTATIONS_BACK[name](values))
        elif name in _WIDTHS_BACK:
            out["width_m"] = _WIDTHS_BACK[name](float(values[0]), max_width_m)
        elif name != "zero":
            raise SpecError(f"{name} alone says too little; give position and rpy or quat_xyzw")
    return out


def _of_rotvec(turn_rad: Numbers) -> list[float]:
    angle_rad = math.hypot(*turn_rad)
    factor = math.sin(angle_rad / 2) / angle_rad if angle_rad > 0 else 0.5
    return [*(factor * value for value in turn_rad), math.cos(angle_rad / 2)]


def _of_rpy(turns_rad: Numbers) -> list[float]:
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in turns_rad)
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]


_ROTATIONS_BACK: Mapping[str, Callable[[Numbers], Numbers]] = {
    "rpy": _of_rpy,
    "rotvec": _of_rotvec,
    "quat_xyzw": lambda values: values,
    "quat_wxyz": lambda values: [*values[1:], values[0]],
}
_WIDTHS_BACK: Mapping[str, Callable[[float, float], float]] = {
    "gripper_m": lambda value, _: value,
    "fingers_m": lambda value, _: 2.0 * value,
    "gripper_open": lambda value, most_m: value * most_m,
    "gripper_closed": lambda value, most_m: (1.0 - value) * most_m,
}
