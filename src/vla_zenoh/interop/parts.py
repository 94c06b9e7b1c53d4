"""A robot's state as the numbers a policy was trained on, and those numbers back as a state.

A part is a name for a few numbers, several are joined by ``+``::

    joint                       positions of the arm's joints, rad
    x y z, position             TCP in the base frame, m
    roll pitch yaw, rpy         its rotation, extrinsic x, y, z, rad
    rx ry rz, rotvec            likewise as axis times angle, rad
    quat_xyzw, quat_wxyz        likewise as a unit quaternion
    gripper_m                   opening, m
    gripper_open                0 shut to 1 open
    gripper_closed              0 open to 1 shut
    fingers_m                   both fingers, +half and -half of the opening, m
    zero, zero*N                N zeros, for what this robot does not have
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.so3 import (
    exp3,
    log3,
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rpy,
)
from vla_zenoh.errors import SpecError
from vla_zenoh.policy import Observation, StatePart
from vla_zenoh.types import FloatArray

OF_STATE: Mapping[str, StatePart | None] = {
    "joint": "joint",
    **dict.fromkeys(("x", "y", "z", "position"), "pose"),
    **dict.fromkeys(("roll", "pitch", "yaw", "rpy", "rx", "ry", "rz", "rotvec"), "pose"),
    **dict.fromkeys(("quat_xyzw", "quat_wxyz"), "pose"),
    **dict.fromkeys(("gripper_m", "gripper_open", "gripper_closed", "fingers_m"), "gripper"),
    "zero": None,
}
"""Part -> which part of the state it is taken from."""

SIZES: Mapping[str, int] = {
    **dict.fromkeys(("position", "rpy", "rotvec"), 3),
    **dict.fromkeys(("quat_xyzw", "quat_wxyz"), 4),
    "fingers_m": 2,
}
"""Numbers of a part; 1 where it is not named here, and ``joint`` has one a joint."""

_ZEROS = re.compile(r"zero\*([1-9][0-9]{0,3})")


def read_parts(text: str) -> tuple[str, ...]:
    """The parts of ``position+rotvec+zero*2``, zeros one by one.

    Raises:
        SpecError: a part that is not known; names those that are.
    """
    parts: list[str] = []
    for part in text.split("+"):
        zeros = _ZEROS.fullmatch(part)
        if zeros is not None:
            parts += ["zero"] * int(zeros[1])
        elif part in OF_STATE:
            parts.append(part)
        else:
            known = ", ".join(OF_STATE)
            raise SpecError(f"no part of the state is called {part!r}; known: {known}")
    return tuple(parts)


def rpy_of(rotation: FloatArray) -> FloatArray:
    """(3,) extrinsic x, y, z in rad; roll is 0 at a pitch of 90 degrees, where many fit."""
    pitch = math.asin(min(max(-rotation[2, 0], -1.0), 1.0))
    if abs(rotation[2, 0]) < 1.0 - 1e-9:
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    else:
        roll, yaw = 0.0, math.atan2(-rotation[0, 1], rotation[1, 1])
    return np.array([roll, pitch, yaw])


def numbers_of(
    parts: Sequence[str], observation: Observation, max_width_m: float
) -> NDArray[np.float32]:
    """The parts of an observation that has them, one after the other."""
    out: list[float] = []
    pose, gripper = observation.pose, observation.gripper
    rotation = rotation_from_quat(pose.quat_xyzw) if pose is not None else np.eye(3)
    for part in parts:
        if part == "zero":
            out.append(0.0)
        elif part == "joint":
            assert observation.joint is not None
            out += observation.joint.position_rad.tolist()
        elif OF_STATE[part] == "gripper":
            assert gripper is not None
            out += _gripper(part, gripper.width_m, max_width_m)
        else:
            assert pose is not None
            out += _pose(part, pose.position_m, rotation, pose.quat_xyzw)
    return np.array(out, np.float32)


def _gripper(part: str, width_m: float, max_width_m: float) -> list[float]:
    fraction = min(max(width_m / max_width_m, 0.0), 1.0)
    return {
        "gripper_m": [width_m],
        "gripper_open": [fraction],
        "gripper_closed": [1.0 - fraction],
        "fingers_m": [width_m / 2, -width_m / 2],
    }[part]


def _pose(
    part: str, position_m: FloatArray, rotation: FloatArray, quat_xyzw: FloatArray
) -> list[float]:
    if part in ("x", "y", "z"):
        return [float(position_m["xyz".index(part)])]
    if part == "position":
        return position_m.tolist()
    if part in ("roll", "pitch", "yaw"):
        return [float(rpy_of(rotation)[("roll", "pitch", "yaw").index(part)])]
    if part == "rpy":
        return rpy_of(rotation).tolist()
    if part in ("rx", "ry", "rz"):
        return [float(log3(rotation)[("rx", "ry", "rz").index(part)])]
    if part == "rotvec":
        return log3(rotation).tolist()
    shift = 0 if part == "quat_xyzw" else 1
    return np.roll(quat_xyzw, shift).tolist()


def state_of(
    parts: Sequence[str], numbers: FloatArray, joints: int, max_width_m: float
) -> dict[str, Any]:
    """The other way round: what the numbers say of the robot.

    Args:
        parts: one after the other; single coordinates (``x``, ``roll``) are not read back.
        numbers: (n,).
        joints: how many the arm has.
        max_width_m: of the gripper.

    Returns:
        any of ``joint`` (n,) rad, ``position_m`` (3,), ``quat_xyzw`` (4,), ``width_m``.

    Raises:
        SpecError: another count of numbers, or a part that cannot be read back.
    """
    sizes = [joints if part == "joint" else SIZES.get(part, 1) for part in parts]
    if numbers.shape != (sum(sizes),):
        raise SpecError(
            f"{'+'.join(parts)} has shape {numbers.shape}, wanted ({sum(sizes)},)", "shape"
        )
    out: dict[str, Any] = {}
    at = 0
    for part, size in zip(parts, sizes, strict=True):
        values, at = numbers[at : at + size], at + size
        if part == "joint":
            out["joint"] = values
        elif part == "position":
            out["position_m"] = values
        elif part == "rpy":
            out["quat_xyzw"] = quat_from_rotation(rotation_from_rpy(values))
        elif part == "rotvec":
            out["quat_xyzw"] = quat_from_rotation(exp3(values))
        elif part in ("quat_xyzw", "quat_wxyz"):
            out["quat_xyzw"] = np.roll(values, 0 if part == "quat_xyzw" else -1)
        elif OF_STATE[part] == "gripper":
            value = float(values[0])
            out["width_m"] = {
                "gripper_m": value,
                "gripper_open": value * max_width_m,
                "gripper_closed": (1.0 - value) * max_width_m,
                "fingers_m": 2.0 * value,
            }[part]
        elif part != "zero":
            raise SpecError(f"{part} alone says too little; give position and rpy or quat_xyzw")
    return out
