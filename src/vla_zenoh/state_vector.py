"""A robot's state as the numbers a policy was trained on; for model environments, numpy alone.

Parts are joined by ``+``, as in ``position+rotvec+gripper_m``:

    joint                           positions of the arm's joints, rad
    position                        TCP in the base frame, m
    rpy, rotvec                     its rotation: extrinsic x, y, z, or axis times angle, rad
    quat_xyzw, quat_wxyz            likewise as a unit quaternion whose w is not negative
    gripper_m, fingers_m            opening, m; both fingers, +half and -half of it, m
    gripper_open, gripper_closed    0 shut to 1 open, and 0 open to 1 shut
    zero                            0, for what this robot does not have
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import Observation, StatePart

PARTS: Mapping[str, tuple[StatePart | None, int]] = {
    "joint": ("joint", 7),
    "position": ("pose", 3),
    "rpy": ("pose", 3),
    "rotvec": ("pose", 3),
    "quat_xyzw": ("pose", 4),
    "quat_wxyz": ("pose", 4),
    "gripper_m": ("gripper", 1),
    "fingers_m": ("gripper", 2),
    "gripper_open": ("gripper", 1),
    "gripper_closed": ("gripper", 1),
    "zero": (None, 1),
}
"""Name -> which part of the robot's state it is taken from, and how many numbers it has."""
UPRIGHT = 1e-7
"""Cosine of a pitch so near to 90 degrees that roll and yaw turn about the same axis."""

Quaternion = Sequence[float] | NDArray[np.float64]


def read_state(text: str, size: int) -> tuple[str, ...]:
    """Names of the parts in `text`, whose numbers are `size` in all.

    Raises:
        SpecError: a name that is not known, or another count; says what there is.
    """
    names = tuple(name.strip() for name in text.split("+") if name.strip())
    known = ", ".join(f"{name} ({count})" for name, (_, count) in PARTS.items())
    strange = [name for name in names if name not in PARTS]
    if strange:
        raise SpecError(f"no part of the state is called {strange[0]!r}; there are: {known}")
    found = sum(PARTS[name][1] for name in names)
    if found != size:
        raise SpecError(
            f"the model's state has {size} numbers, {text!r} has {found}; "
            f"join its parts by +, in order: {known}"
        )
    return names


def parts_of(names: Sequence[str]) -> tuple[StatePart, ...]:
    """What a model has to observe for them."""
    return tuple(dict.fromkeys(part for name in names if (part := PARTS[name][0]) is not None))


def state_vector(
    names: Sequence[str], observation: Observation, max_width_m: float
) -> NDArray[np.float32]:
    """(n,) the numbers.

    Args:
        names: of `read_state`.
        observation: has what `parts_of` says.
        max_width_m: of the open gripper.
    """
    joint, pose, gripper = observation.joint, observation.pose, observation.gripper
    out: list[float] = []
    for name in names:
        if joint is not None and name == "joint":
            out += joint.position_rad.tolist()
        elif pose is not None and name == "position":
            out += pose.position_m.tolist()
        elif pose is not None and name in ROTATIONS:
            out += ROTATIONS[name](pose.quat_xyzw)
        elif gripper is not None and name in GRIPPERS:
            out += GRIPPERS[name](gripper.width_m, max_width_m)
        else:
            out.append(0.0)
    return np.array(out, np.float32)


def quat_xyzw(quaternion: Quaternion) -> list[float]:
    """The same rotation, x, y, z, w with w >= 0."""
    sign = -1.0 if quaternion[3] < 0 else 1.0
    return [sign * float(value) for value in quaternion]


def quat_wxyz(quaternion: Quaternion) -> list[float]:
    """Likewise w, x, y, z."""
    *axis, w = quat_xyzw(quaternion)
    return [w, *axis]


def rotvec(quaternion: Quaternion) -> list[float]:
    """Axis times angle in rad, angle within [0, pi]."""
    x, y, z, w = quat_xyzw(quaternion)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return [factor * x, factor * y, factor * z]


def rpy(quaternion: Quaternion) -> list[float]:
    """Roll, pitch, yaw in rad: turns about the fixed x, y, z, one after the other."""
    x, y, z, w = quat_xyzw(quaternion)
    ahead, aside = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    sine, cosine = 2 * (w * y - z * x), math.hypot(ahead, aside)
    pitch = math.atan2(sine, cosine)
    if cosine < UPRIGHT:  # only the sum, or difference, of the other two is known
        return [0.0, pitch, math.copysign(2.0, -sine) * math.atan2(x, w)]
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return [roll, pitch, math.atan2(aside, ahead)]


def _open(width_m: float, max_width_m: float) -> float:
    return min(max(width_m / max_width_m, 0.0), 1.0)


ROTATIONS: Mapping[str, Callable[[Quaternion], list[float]]] = {
    "rpy": rpy,
    "rotvec": rotvec,
    "quat_xyzw": quat_xyzw,
    "quat_wxyz": quat_wxyz,
}
GRIPPERS: Mapping[str, Callable[[float, float], list[float]]] = {
    "gripper_m": lambda width_m, _: [width_m],
    "fingers_m": lambda width_m, _: [width_m / 2, -width_m / 2],
    "gripper_open": lambda width_m, most_m: [_open(width_m, most_m)],
    "gripper_closed": lambda width_m, most_m: [1 - _open(width_m, most_m)],
}
