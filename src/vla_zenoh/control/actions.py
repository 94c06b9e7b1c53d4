"""Meaning of the numbers of an action step: from `ActionSpec` to TCP pose and gripper width.

A controller that covers only a part of each delta sets its goal g at every step on where the arm
is, and the arm moves there as a mass on a spring with a damper until the next step::

    g = x(0) + delta        x'' = kp (g - x) - 2 z w x',  w = sqrt(kp)

With ``e = x - g`` and ``s = w sqrt(z^2 - 1)``, imaginary below critical damping::

    e(t)  = exp(-z w t) (e(0) cosh(s t) + (e'(0) + z w e(0)) sinh(s t) / s)
    e'(t) = exp(-z w t) (e'(0) cosh(s t) - (z w e'(0) + w^2 e(0)) sinh(s t) / s)

Position and rate at the end of a step begin the next one, also across chunks: what a policy does to
the arm depends on its steps alone, not on how they are divided into chunks or how often it is
asked. The rotation vector of the turn since the step began takes the place of x for rotations.

Source: robosuite's operational space controller (``OSC_POSE``, the controller of LIBERO): kp 150,
damping ratio 1, 20 Hz. Its rotation error is ``sin(angle) axis``, and its orientation goal stays
where it is while the rotation numbers are all exactly zero.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError, SpecError
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    log3,
    norm3,
    orthonormal,
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rpy,
)
from vla_zenoh.policy import ActionSpec, ControllerSpec
from vla_zenoh.policy.meaning import nearest_turn, unturned
from vla_zenoh.types import FloatArray, unit_quaternion

Steps = NDArray[np.float32] | NDArray[np.float64]
FURTHEST_RAD = 4 * math.pi
"""No joint target is further from zero; one in degrees is."""
GRIPPER_SLACK = 0.25
"""A fraction outside [0, 1] by up to this is rounding of a model, and clipped."""
GRIPPER_SLACK_M, GRIPPER_SLACK_SHARE = 0.05, 0.7
"""A width outside the gripper's range by up to this, or this share of it, is clipped, too."""
NO_CUT = 1e-9
"""A translation or rotation that is shortened by less counts as complete."""


def rotation_of(spec: ActionSpec, numbers: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of the rotation numbers of a step.

    Raises:
        RecordError: a quaternion that is not a unit quaternion, or a 6D rotation without two
            directions.
    """
    if spec.rotation == "rotation_6d":
        try:
            return rotation_from_quat(np.array(spec.rotation_form.decode(numbers)))
        except SpecError as error:
            raise RecordError(str(error)) from error
    if spec.rotation == "rpy":
        return rotation_from_rpy(numbers)
    if spec.rotation == "rotvec":
        return exp3(numbers)
    return rotation_from_quat(unit_quaternion("rotation of the action", numbers))


def turns(spec: ActionSpec, step: FloatArray) -> bool:
    """Whether the rotation numbers of a step are others than those of no rotation."""
    if spec.rotation == "rotation_6d":
        return bool(np.any(step[spec.rotation_columns] != unturned(spec.rotation)))
    return bool(np.any(step[3:6]))  # of a quaternion x, y, z


def step_pose(spec: ActionSpec, step: FloatArray, before: Pose, start: Pose | None = None) -> Pose:
    """The pose that a step (D,) asks for, covered whole.

    A delta in the base frame is ``p + dp, dR R``; in the TCP frame ``p + R dp, R dR``, of the step
    `before` or of the chunk's `start` as `ActionSpec.relative_to` says. A velocity is the delta
    ``v dt, exp(w dt)``. An absolute step is the pose itself.
    """
    translation = np.asarray(step[:3], np.float64) * spec.position_scale_m
    turn = np.asarray(step[spec.rotation_columns], np.float64)
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
    spec: ActionSpec,
    step: FloatArray,
    before_rad: FloatArray,
    start_rad: FloatArray,
    endless: NDArray[np.bool_],
) -> FloatArray:
    """The joints (n,) that a step (D,) asks for, after `before_rad` in a chunk from `start_rad`.

    A target goes the shortest way from the step before with the joints (n,) that are `endless`.
    """
    numbers = np.asarray(step[: spec.arm_size], np.float64)
    if spec.kind == "velocity":
        return before_rad + numbers * spec.dt_s
    if not spec.targets:
        return before_rad + numbers
    target_rad = numbers if spec.kind == "absolute" else start_rad + numbers
    return np.where(endless, nearest_turn(target_rad, before_rad), target_rad)


def covered_step(
    spec: ActionSpec, step: FloatArray, before: Pose, start: Pose, state: Response | None
) -> tuple[Pose, Response | None]:
    """Where a step (D,) ends, of which `ActionSpec.controller` may cover only a part.

    With the controller's response there, as `state` is that at `before`; None: at rest. The
    orientation goal stays where the step does not turn.
    """
    asked = step_pose(spec, step, before, start)
    if spec.controller is None:
        return asked, None
    rate = np.zeros(6) if state is None else state.rate
    if turns(spec, step):
        turn = asked.rotation @ before.rotation.T
        aim = orthonormal(turn @ before.rotation)
    else:
        aim = before.rotation if state is None else state.aim
    error = log3(aim @ before.rotation.T)
    angle = norm3(error)
    if angle > 0.0:
        error = math.sin(angle) / angle * error
    way = np.concatenate([asked.position_m - before.position_m, error])
    moved, reached = _motion(spec.controller, rate, way, spec.dt_s)
    return _after(before, moved), Response(spec.controller, reached, aim, rate, way)


def chunk_poses(spec: ActionSpec, steps: Steps, start: Pose) -> list[Pose]:
    """The pose at the end of each step of a chunk that begins at `start`, at rest there."""
    poses: list[Pose] = []
    before, state = start, None
    for step in steps:
        before, state = covered_step(spec, np.asarray(step, np.float64), before, start, state)
        poses.append(before)
    return poses


def as_deltas(spec: ActionSpec, steps: Steps) -> tuple[ActionSpec, FloatArray]:
    """The same chunk of one arm as deltas, each added to the step before, with the spec of them.

    A chunk of deltas on the previous step, or of absolute poses, is returned as it is, but with
    quaternions in place of 6D rotations.
    """
    spec, steps = with_quaternions(spec, np.asarray(steps, np.float64))
    size = spec.arm_size
    if spec.kind == "velocity":
        scaled = np.concatenate([steps[:, :size] * spec.dt_s, steps[:, size:]], axis=1)
        return spec.model_copy(update={"kind": "delta"}), scaled
    if spec.relative_to == "previous":
        return spec, steps
    if spec.space == "joint":
        ways = np.diff(steps[:, :size], axis=0, prepend=np.zeros((1, size)))
        changed = {"relative_to": "previous"}
        return spec.model_copy(update=changed), np.concatenate([ways, steps[:, size:]], axis=1)
    origin = Pose(np.zeros(3), np.eye(3))
    rows: list[FloatArray] = []
    for before, after in pairwise([origin, *chunk_poses(spec, steps, origin)]):
        way_m = after.position_m - before.position_m
        turn = log3(after.rotation @ before.rotation.T)
        if spec.frame == "tcp":
            way_m = before.rotation.T @ way_m
            turn = log3(before.rotation.T @ after.rotation)
        rows.append(np.concatenate([way_m, turn]))
    changed = {"relative_to": "previous", "rotation": "rotvec", "position_scale_m": 1.0}
    return spec.model_copy(update=changed), np.concatenate([rows, steps[:, size:]], axis=1)


def with_quaternions(spec: ActionSpec, steps: FloatArray) -> tuple[ActionSpec, FloatArray]:
    """The same steps (H, D) with quaternions in place of 6D rotations, with the spec of them.

    Raises:
        RecordError: a 6D rotation without two directions.
    """
    if spec.space == "joint" or spec.rotation != "rotation_6d":
        return spec, steps
    quats = [quat_from_rotation(rotation_of(spec, row)) for row in steps[:, spec.rotation_columns]]
    rows = np.concatenate(
        [steps[:, :3], np.array(quats), steps[:, spec.rotation_columns.stop :]], axis=1
    )
    return spec.model_copy(update={"rotation": "quaternion"}), rows


def gripper_range(spec: ActionSpec, max_width_m: float) -> tuple[float, float]:
    """Least and greatest gripper number of the declared meaning; of a choice of two any is one."""
    slack_m = min(GRIPPER_SLACK_M, GRIPPER_SLACK_SHARE * max_width_m)
    if spec.gripper == "delta_m":
        return -max_width_m - slack_m, max_width_m + slack_m
    if spec.gripper == "absolute_m":
        return -min(0.01, slack_m), max_width_m + slack_m
    if spec.gripper == "open_fraction":
        return -GRIPPER_SLACK, 1.0 + GRIPPER_SLACK
    return -math.inf, math.inf


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
    if math.isnan(max_width_m):
        raise RecordError(f"gripper {spec.gripper}: the robot has no gripper")
    value, (low, high) = float(step[-1]), gripper_range(spec, max_width_m)
    if not low <= value <= high:
        of_width = f" m; this gripper opens to {max_width_m:g} m"
        wanted = "; wanted a number in [0, 1]" if spec.gripper == "open_fraction" else of_width
        raise RecordError(f"gripper {spec.gripper} of {value:g}{wanted}")
    if spec.gripper == "delta_m":
        wanted_m = before_m + value
    elif spec.gripper == "binary":
        wanted_m = max_width_m * spec.opens(value)
    else:
        wanted_m = max_width_m * spec.gripper_scale(max_width_m).decode(value)
    return min(max(wanted_m, 0.0), max_width_m)


# -- controllers that cover a part of a step -----------------------------------------------------
@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """State of a controller's response at the end of a step.

    Args:
        controller: its gains.
        rate: (6,) of the arm, m/s and rad/s in base axes.
        aim: (3, 3) orientation goal.
        start_rate: (6,) of the arm when the step began.
        way: (6,) from there to the controller's goal, m and rad.
    """

    controller: ControllerSpec
    rate: FloatArray
    aim: FloatArray
    start_rate: FloatArray
    way: FloatArray

    def stopped(self, asked: Pose, reached: Pose) -> Response:
        """The state where a limit ended the step at `reached`: nothing moves on into the limit."""
        cut_m = asked.position_m - reached.position_m
        cut_rad = log3(asked.rotation @ reached.rotation.T)
        rate = self.rate.copy()
        for part, cut in ((rate[:3], cut_m), (rate[3:], cut_rad)):
            length = norm3(cut)
            if length > NO_CUT:
                part -= max(float(part @ cut), 0.0) / length**2 * cut
        return replace(self, rate=rate)


def between(
    before: Pose, after: Pose, state: Response, dt_s: float, share: float
) -> tuple[Pose, Response]:
    """Pose and state at `share` (0 to 1) of a step of `dt_s` that ends at `after` in `state`.

    What a limit cut off of it is cut off evenly.
    """
    whole, whole_rate = _motion(state.controller, state.start_rate, state.way, dt_s)
    moved, rate = _motion(state.controller, state.start_rate, state.way, share * dt_s)
    end, here = _after(before, whole), _after(before, moved)
    left = log3(after.rotation @ end.rotation.T)
    pose = Pose(
        here.position_m + share * (after.position_m - end.position_m),
        orthonormal(exp3(share * left) @ here.rotation),
    )
    return pose, replace(state, rate=rate + share * (state.rate - whole_rate))


def _motion(
    controller: ControllerSpec, rate: FloatArray, way: FloatArray, t_s: float
) -> tuple[FloatArray, FloatArray]:
    """Displacement and rate (6,) after `t_s`."""
    w, zw = math.sqrt(controller.kp), controller.damping_ratio * math.sqrt(controller.kp)
    s = cmath.sqrt(zw * zw - w * w)
    # exp(-z w t) cosh(s t) and exp(-z w t) sinh(s t) / s, without the overflow of a large s t.
    slow, fast = cmath.exp((s - zw) * t_s), cmath.exp(-(s + zw) * t_s)
    cosh = (slow + fast).real / 2
    if abs(s) * t_s < 1e-3:
        sinh = math.exp(-zw * t_s) * t_s * (1 + (s * t_s) ** 2 / 6).real
    else:
        sinh = ((slow - fast) / (2 * s)).real
    moved = way - way * cosh + (rate - zw * way) * sinh
    return moved, rate * cosh - (zw * rate - w * w * way) * sinh


def _after(before: Pose, moved: FloatArray) -> Pose:
    turned = orthonormal(exp3(moved[3:]) @ before.rotation)
    return Pose(before.position_m + moved[:3], turned)
