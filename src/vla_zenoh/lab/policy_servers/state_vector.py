"""A robot's state as the numbers a policy was trained on, and back.

For model environments: numpy alone. Parts are joined by ``+``, as in ``position+rotvec+gripper_m``:

    joint, joint_deg                positions of the arm's joints, rad or degrees: as many as it has
    position, x y z                 TCP in the base frame, m
    rpy, roll pitch yaw             its rotation: extrinsic x, y, z, rad
    rotvec, rx ry rz                its rotation: axis times angle, rad
    quat_xyzw, quat_wxyz            its rotation: unit quaternion with w >= 0
    wrench                          external, at the TCP: force N, torque Nm, base axes
    effort                          of the arm's joints, Nm
    gripper_m, fingers_m            opening, m; both fingers, +half and -half of it, m
    gripper_open, gripper_closed    0 shut to 1 open, and 0 open to 1 shut
    zero, zero*N                    N zeros, for what this robot does not have
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import Observation, StatePart

COORDINATES: Mapping[str, tuple[str, ...]] = {
    "position": ("x", "y", "z"),
    "rpy": ("roll", "pitch", "yaw"),
    "rotvec": ("rx", "ry", "rz"),
}
"""Parts whose numbers have names of their own."""
PARTS: Mapping[str, tuple[StatePart | None, int | None]] = {
    "joint": ("joint", None),
    "joint_deg": ("joint", None),
    **{whole: ("pose", 3) for whole in COORDINATES},
    **{name: ("pose", 1) for names in COORDINATES.values() for name in names},
    "quat_xyzw": ("pose", 4),
    "quat_wxyz": ("pose", 4),
    "gripper_m": ("gripper", 1),
    "fingers_m": ("gripper", 2),
    "gripper_open": ("gripper", 1),
    "gripper_closed": ("gripper", 1),
    "wrench": ("wrench", 6),
    "effort": ("effort", None),
    "zero": (None, 1),
}
"""Name -> which part of the robot's state it is taken from, and how many numbers it has; None: as
many as the arm has joints."""
UPRIGHT = 1e-7
"""Cosine of a pitch so near to 90 degrees that roll and yaw turn about the same axis."""

_ZEROS = re.compile(r"zero\*([1-9][0-9]{0,3})")
_WHOLE = {name: (whole, i) for whole, names in COORDINATES.items() for i, name in enumerate(names)}

Numbers = Sequence[float] | NDArray[np.float64]


# -- names ----------------------------------------------------------------------------------------
def read_parts(text: str) -> tuple[str, ...]:
    """Names of the parts in ``position+rotvec+zero*2``, zeros one by one; none of an empty text.

    Raises:
        SpecError: a name that is not known; says what there is.
    """
    names: list[str] = []
    for name in (part.strip() for part in text.split("+") if text.strip()):
        zeros = _ZEROS.fullmatch(name)
        if zeros is None and name not in PARTS:
            raise SpecError(f"no part of the state is called {name!r}; there are: {known_parts()}")
        names += ["zero"] * int(zeros[1]) if zeros is not None else [name]
    return tuple(names)


def read_state(text: str, size: int, joints: int, *more: int) -> tuple[str, ...]:
    """Names of the parts in `text`, whose numbers are `size` in all.

    Args:
        text: see `read_parts`; of a robot of several arms that of each, one after the other.
        size: how many numbers the model wants.
        more: how many each further arm has.

    Raises:
        SpecError: a name that is not known, or another count; says what there is.
    """
    names = read_parts(text)
    found = sum(size_of(name, count) for count in (joints, *more) for name in names)
    if found != size:
        each = f" of {1 + len(more)} arms" if more else ""
        raise SpecError(
            f"the model's state has {size} numbers, {text!r}{each} has {found}; "
            f"join its parts by +, in order: {known_parts(joints)}"
        )
    return names


def size_of(name: str, joints: int) -> int:
    """Size of a part, for an arm with `joints`."""
    count = PARTS[name][1]
    return joints if count is None else count


def known_parts(joints: int | None = None) -> str:
    """All names with their sizes, as text; `joints`: of the arm, if known."""
    counts = {name: count for name, (_, count) in PARTS.items()}
    of_arm = "one for each of the arm's" if joints is None else joints
    return ", ".join(
        f"{name} ({of_arm if count is None else count})" for name, count in counts.items()
    )


def parts_of(names: Sequence[str]) -> tuple[StatePart, ...]:
    """Parts of the state that a model must observe for them."""
    return tuple(dict.fromkeys(part for name in names if (part := PARTS[name][0]) is not None))


# -- a state as numbers ---------------------------------------------------------------------------
def state_vector(
    names: Sequence[str], observation: Observation, max_width_m: float
) -> NDArray[np.float32]:
    """(n,) the numbers.

    Args:
        names: of `read_parts`.
        observation: has the state of `parts_of`.
        max_width_m: of the open gripper.
    """
    joint, pose, gripper = observation.joint, observation.pose, observation.gripper
    out: list[float] = []
    for name in names:
        whole, index = _WHOLE.get(name, (name, None))
        if joint is not None and name in JOINTS:
            in_degrees = name == "joint_deg"
            numbers = (np.rad2deg if in_degrees else np.asarray)(joint.position_rad).tolist()
        elif pose is not None and whole == "position":
            numbers = pose.position_m.tolist()
        elif pose is not None and whole in ROTATIONS:
            numbers = ROTATIONS[whole][0](pose.quat_xyzw)
        elif name == "wrench" and observation.wrench is not None:
            numbers = observation.wrench.tolist()
        elif name == "effort" and observation.effort_nm is not None:
            numbers = observation.effort_nm.tolist()
        elif gripper is not None and name in GRIPPERS:
            numbers = GRIPPERS[name][0](gripper.width_m, max_width_m)
        else:
            numbers = [0.0]
        out += numbers if index is None else [numbers[index]]
    return np.array(out, np.float32)


def state_of(
    names: Sequence[str], numbers: NDArray[np.float64], joints: int, max_width_m: float
) -> dict[str, Any]:
    """The inverse of `state_vector`: what the numbers say of the robot.

    Args:
        names: of `read_parts`; single coordinates (``x``, ``roll``) are not read back.
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
            out["joint"] = np.deg2rad(values) if name == "joint_deg" else values
        elif name == "position":
            out["position_m"] = values
        elif name in ROTATIONS:
            out["quat_xyzw"] = np.array(ROTATIONS[name][1](values.tolist()))
        elif name in GRIPPERS:
            out["width_m"] = GRIPPERS[name][1](float(values[0]), max_width_m)
        elif name != "zero":
            raise SpecError(f"{name} alone says too little; give position and rpy or quat_xyzw")
    return out


# -- forms ----------------------------------------------------------------------------------------
def quat_xyzw(quaternion: Numbers) -> list[float]:
    """The same rotation, x, y, z, w with w >= 0."""
    sign = -1.0 if quaternion[3] < 0 else 1.0
    return [sign * float(value) for value in quaternion]


def quat_wxyz(quaternion: Numbers) -> list[float]:
    """The same rotation, w, x, y, z with w >= 0."""
    *axis, w = quat_xyzw(quaternion)
    return [w, *axis]


def rotvec(quaternion: Numbers) -> list[float]:
    """Axis times angle in rad, angle within [0, pi]."""
    x, y, z, w = quat_xyzw(quaternion)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return [factor * x, factor * y, factor * z]


def rpy(quaternion: Numbers) -> list[float]:
    """Roll, pitch, yaw in rad: turns about the fixed x, y, z, one after the other."""
    x, y, z, w = quat_xyzw(quaternion)
    ahead, aside = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    sine, cosine = 2 * (w * y - z * x), math.hypot(ahead, aside)
    pitch = math.atan2(sine, cosine)
    if cosine < UPRIGHT:  # only the sum, or difference, of the other two is known
        return [0.0, pitch, math.copysign(2.0, -sine) * math.atan2(x, w)]
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return [roll, pitch, math.atan2(aside, ahead)]


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


def _open(width_m: float, max_width_m: float) -> float:
    return min(max(width_m / max_width_m, 0.0), 1.0)


JOINTS = ("joint", "joint_deg")
ROTATIONS: Mapping[
    str, tuple[Callable[[Numbers], list[float]], Callable[[list[float]], list[float]]]
] = {
    "rpy": (rpy, _of_rpy),
    "rotvec": (rotvec, _of_rotvec),
    "quat_xyzw": (quat_xyzw, list),
    "quat_wxyz": (quat_wxyz, lambda values: [*values[1:], values[0]]),
}
"""Name -> numbers of a quaternion x, y, z, w, and the other way round."""
GRIPPERS: Mapping[
    str, tuple[Callable[[float, float], list[float]], Callable[[float, float], float]]
] = {
    "gripper_m": (lambda width_m, _: [width_m], lambda value, _: value),
    "fingers_m": (lambda width_m, _: [width_m / 2, -width_m / 2], lambda value, _: 2.0 * value),
    "gripper_open": (
        lambda width_m, most_m: [_open(width_m, most_m)],
        lambda value, most_m: value * most_m,
    ),
    "gripper_closed": (
        lambda width_m, most_m: [1 - _open(width_m, most_m)],
        lambda value, most_m: (1.0 - value) * most_m,
    ),
}
"""Name -> numbers of an opening, and the opening by their first, both with that of the open one."""
