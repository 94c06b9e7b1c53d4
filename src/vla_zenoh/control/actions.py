"""Meaning of the numbers of an action step: from `ActionSpec` to TCP pose and gripper width."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.controller_response import Response, respond
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    log3,
    orthonormal,
    rotation_from_quat,
    rotation_from_rpy,
)
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, Frame
from vla_zenoh.types import FloatArray, unit_quaternion

Steps = NDArray[np.float32] | NDArray[np.float64]
FURTHEST_RAD = 4 * math.pi
"""No joint target is further from zero; one in degrees is."""
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


def step_pose(spec: ActionSpec, step: FloatArray, before: Pose, start: Pose | None = None) -> Pose:
    """The pose that a step asks for, covered whole.

    A delta in the base frame is ``p + dp, dR R``; in the TCP frame ``p + R dp, R dR``, of the step
    before or of the chunk's start as `ActionSpec.relative_to` says. A velocity is the delta
    ``v dt, exp(w dt)``. An absolute step is the pose itself.

    Args:
        spec: the meaning of the numbers.
        step: (D,).
        before: end of the step before.
        start: the anchor of the chunk; None: `before` is.
    """
    translation = np.asarray(step[:3], dtype=np.float64) * spec.position_scale_m
    turn = np.asarray(step[3 : 3 + ROTATION_SIZE[spec.rotation]], dtype=np.float64)
    if spec.kind == "velocity":
        translation, turn = translation * spec.dt_s, turn * spec.dt_s
    rotation = rotation_of(spec, turn)
    if spec.kind == "absolute":
        return Pose(translation, rotation)
    if spec.relative_to == "start" and start is not None:
        before = start
    if spec.frame == "tcp":
        return Pose(
            before.position_m + before.rotation @ translation,
            orthonormal(before.rotation @ rotation),
        )
    return Pose(before.position_m + translation, orthonormal(rotation @ before.rotation))


def step_joints(
    spec: ActionSpec, step: FloatArray, before_rad: FloatArray, start_rad: FloatArray
) -> FloatArray:
    """The joints (n,) that a step (D,) asks for.

    Args:
        spec: the meaning of the numbers.
        step: (D,).
        before_rad: (n,) end of the step before.
        start_rad: (n,) anchor of the chunk.
    """
    numbers = np.asarray(step[: spec.arm_size], dtype=np.float64)
    if spec.kind == "absolute":
        return numbers
    if spec.kind == "velocity":
        return before_rad + numbers * spec.dt_s
    return (start_rad if spec.relative_to == "start" else before_rad) + numbers


def covered_step(
    spec: ActionSpec, step: FloatArray, before: Pose, start: Pose, state: Response | None
) -> tuple[Pose, Response | None]:
    """Where a step ends, of which `ActionSpec.controller` may cover only a part.

    Args:
        spec: the meaning of the numbers.
        step: (D,).
        before: end of the step before.
        start: the anchor of the chunk.
        state: of the controller's response at `before`; None: at rest.
    """
    asked = step_pose(spec, step, before, start)
    if spec.controller is None:
        return asked, None
    turns = np.any(step[3:6])  # of a quaternion x, y, z
    turn = asked.rotation @ before.rotation.T if turns else None
    way_m = asked.position_m - before.position_m
    return respond(spec.controller, way_m, turn, spec.dt_s, before, state)


def chunk_poses(spec: ActionSpec, steps: Steps, start: Pose) -> list[Pose]:
    """The pose at the end of each step of a chunk that begins at `start`, at rest there."""
    poses: list[Pose] = []
    before, state = start, None
    for step in steps:
        before, state = covered_step(spec, np.asarray(step, np.float64), before, start, state)
        poses.append(before)
    return poses


def as_deltas(spec: ActionSpec, steps: Steps) -> tuple[ActionSpec, FloatArray]:
    """The same chunk as deltas that are each added to the step before, with the spec of them.

    A chunk of deltas on the previous step, or of absolute poses, is returned as it is.
    """
    steps = np.asarray(steps, np.float64)
    if spec.parts:
        own = {p.part: as_deltas(p.action, steps[:, spec.columns(p.part)]) for p in spec.parts}
        action = ActionSpec.of_parts({part: meant for part, (meant, _) in own.items()})
        return action, np.concatenate([rows for _, rows in own.values()], axis=1)
    if spec.kind == "velocity":
        size = spec.arm_size
        scaled = np.concatenate([steps[:, :size] * spec.dt_s, steps[:, size:]], axis=1)
        return spec.model_copy(update={"kind": "delta"}), scaled
    if spec.relative_to == "previous":
        return spec, steps
    if spec.space == "joint":
        size = spec.arm_size
        rows = np.diff(steps[:, :size], axis=0, prepend=np.zeros((1, size)))
        changed = {"relative_to": "previous"}
        return spec.model_copy(update=changed), np.concatenate([rows, steps[:, size:]], axis=1)
    origin = Pose(np.zeros(3), np.eye(3))
    poses = [origin, *chunk_poses(spec, steps, origin)]
    rows = [
        np.concatenate([into @ (after.position_m - before.position_m), turn])
        for before, after in pairwise(poses)
        for into, turn in [_relative(spec.frame, before, after)]
    ]
    changed = {"relative_to": "previous", "rotation": "rotvec", "position_scale_m": 1.0}
    size = spec.arm_size
    return spec.model_copy(update=changed), np.concatenate([rows, steps[:, size:]], axis=1)


def _relative(frame: Frame, before: Pose, after: Pose) -> tuple[FloatArray, FloatArray]:
    """Axes of a frame in the base, inverted, and the turn between two poses in them."""
    if frame == "tcp":
        return before.rotation.T, log3(before.rotation.T @ after.rotation)
    return np.eye(3), log3(after.rotation @ before.rotation.T)


def step_width(
    spec: ActionSpec, step: FloatArray, before_m: float, max_width_m: float
) -> float | None:
    """The gripper width that a step asks for, from `before_m`; None: the model has no gripper.

    Raises:
        RecordError: a number that is impossible by the declared meaning. The message names it:
            usually the spec declares another meaning than the model's.
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
