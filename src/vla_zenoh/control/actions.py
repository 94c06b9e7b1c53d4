"""Meaning of the numbers of an action step: from `ActionSpec` to TCP pose and gripper width."""

from __future__ import annotations

import numpy as np

from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    orthonormal,
    rotation_from_quat,
    rotation_from_rpy,
)
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec
from vla_zenoh.types import FloatArray, unit_quaternion

GRIPPER_SLACK = 0.25
"""A fraction outside [0, 1] by up to this is rounding of a model, and clipped."""
GRIPPER_SLACK_M = 0.05
"""A width outside the gripper's range by up to this is clipped, too."""


def rotation_of(spec: ActionSpec, numbers: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of the rotation numbers of a step.

    Raises:
        RecordError: a quaternion that is not a unit quaternion.
    """
    if spec.rotation == "rpy":
        return rotation_from_rpy(numbers)
    if spec.rotation == "rotvec":
        return exp3(numbers)
    return rotation_from_quat(unit_quaternion("rotation of the action", numbers))


def step_pose(spec: ActionSpec, step: FloatArray, before: Pose) -> Pose:
    """The pose that a step asks for, from the goal `before`.

    A delta in the base frame is ``p + dp, dR R``; in the TCP frame ``p + R dp, R dR``; an absolute
    step is the pose itself.
    """
    translation = np.asarray(step[:3], dtype=np.float64) * spec.position_scale_m
    size = ROTATION_SIZE[spec.rotation]
    rotation = rotation_of(spec, np.asarray(step[3 : 3 + size], dtype=np.float64))
    if spec.kind == "absolute":
        return Pose(translation, rotation)
    if spec.frame == "tcp":
        return Pose(
            before.position_m + before.rotation @ translation,
            orthonormal(before.rotation @ rotation),
        )
    return Pose(before.position_m + translation, orthonormal(rotation @ before.rotation))


def step_joints(spec: ActionSpec, step: FloatArray, before_rad: FloatArray) -> FloatArray:
    """The joints (n,) that a step (D,) asks for, from the goal `before_rad` (n,)."""
    numbers = np.asarray(step[: spec.arm_size], dtype=np.float64)
    return numbers if spec.kind == "absolute" else before_rad + numbers


def step_width(
    spec: ActionSpec, step: FloatArray, before_m: float, max_width_m: float
) -> float | None:
    """The gripper width that a step asks for, from `before_m`; None: the model has no gripper.

    Raises:
        RecordError: a number that this meaning cannot have. The message names the meaning: usually
            the spec declares another one than the model has.
    """
    if spec.gripper == "none":
        return None
    value = float(step[-1])
    if spec.gripper == "delta_m":
        if abs(value) > max_width_m + GRIPPER_SLACK_M:
            raise RecordError(
                f"gripper delta_m of {value:g} m; this gripper opens to {max_width_m:g} m"
            )
        wanted_m = before_m + value
    elif spec.gripper == "absolute_m":
        if not -0.01 <= value <= max_width_m + GRIPPER_SLACK_M:
            raise RecordError(
                f"gripper absolute_m of {value:g} m; this gripper opens to {max_width_m:g} m"
            )
        wanted_m = value
    else:
        if spec.gripper == "open_fraction":
            if not -GRIPPER_SLACK <= value <= 1 + GRIPPER_SLACK:
                raise RecordError(f"gripper open_fraction of {value:g}; wanted a number in [0, 1]")
            fraction = value
        else:
            fraction = float(value > spec.gripper_threshold)
        if not spec.gripper_open_is_high:
            fraction = 1.0 - fraction
        wanted_m = fraction * max_width_m
    return min(max(wanted_m, 0.0), max_width_m)
