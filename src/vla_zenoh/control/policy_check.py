"""Static checks of a model against a profile: does its spec fit, and are its chunks plausible?

No model runs here. Wrong units show in the size of the numbers: a step in millimetres or degrees is
far above what an arm may do, and above `vla_zenoh.profile.REJECT_FACTOR` times a limit the command
node rejects the chunk.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import GRIPPER_SLACK, GRIPPER_SLACK_M
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, CameraSpec, ModelSpec
from vla_zenoh.profile import POSE_JOINTS, REACH_M, REJECT_FACTOR, Limits, Profile
from vla_zenoh.types import QUATERNION_NORM_TOLERANCE

SHAPE_TOLERANCE = 0.02
"""An image may be stretched by this share of its aspect ratio without a note."""
BINARY_SPAN = 2.0
"""A number further than this from the threshold is not a choice of two but another quantity."""
ROUNDING = 1e-6

Steps = NDArray[np.float32]
Level = Literal["error", "warning", "note"]


class Finding(NamedTuple):
    """One result of a check.

    Args:
        level: ``error``: the model must not get the arm; ``warning``: look at it; ``note``.
        name: stable short name.
        why: a sentence with the value found and the value expected.
    """

    level: Level
    name: str
    why: str


def error(name: str, why: str) -> Finding:
    """A finding that keeps the model from the arm."""
    return Finding("error", name, why)


def warning(name: str, why: str) -> Finding:
    """A finding to look at before the model gets the arm."""
    return Finding("warning", name, why)


def note(name: str, why: str) -> Finding:
    """A finding that is good to know."""
    return Finding("note", name, why)


# -- the spec -------------------------------------------------------------------------------------
def check_spec(
    profile: Profile, spec: ModelSpec, *, worker: str, rate_hz: float | None = None
) -> list[Finding]:
    """Findings about a spec on a profile.

    Args:
        profile: the effective profile.
        spec: what the model declares.
        worker: name of the worker.
        rate_hz: chunks per second requested; None: by the profile.
    """
    rate_hz = rate_hz or profile.task.rate_hz
    return [
        *_cameras(profile, spec),
        *_joints(profile, spec),
        *_timing(profile, spec, rate_hz),
        *_task(profile, spec, worker),
    ]


def _cameras(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    wanted = spec.observation
    known = [camera for camera in wanted.cameras if camera.camera in profile.cameras]
    for camera in wanted.cameras:
        if camera not in known:
            yield error(
                "camera",
                f"needs camera {camera.camera!r}, the profile has: "
                f"{', '.join(profile.cameras) or 'none'}; add it to cameras, or name another in "
                "the model's options",
            )
            continue
        yield from _size(profile, camera)
        rate_hz = profile.cameras[camera.camera].rate_hz
        if wanted.max_age_s * rate_hz < 1.0:
            yield error(
                "camera_rate",
                f"camera {camera.camera!r} gives a picture every {1 / rate_hz:.2f} s, the spec "
                f"allows none older than {wanted.max_age_s:g} s",
            )
    slowest = min((profile.cameras[camera.camera].rate_hz for camera in known), default=0.0)
    if len(known) > 1 and wanted.max_skew_s * slowest < 1.0:
        yield warning(
            "camera_rate",
            f"at {slowest:g} Hz pictures may lie {1 / slowest:.3f} s apart, the spec allows "
            f"{wanted.max_skew_s:g} s: many observations will be refused",
        )


def _joints(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    joints = len(profile.robot.arm_joints)
    if joints >= POSE_JOINTS:
        return
    short = f"robot {profile.robot.name!r} has {joints} arm joints, a pose of the TCP needs six"
    if spec.action.kind == "absolute":
        yield error(
            "too_few_joints",
            f"{short}: it cannot go straight from one absolute pose to the next, also where joint "
            "positions were made into poses; use a model whose action is delta",
        )
        return
    yield warning(
        "too_few_joints",
        f"{short}: steps that it has no joint for are shortened, to nothing at worst (limit "
        "reach); `vla-zenoh profile check` names the axes",
    )


def _size(profile: Profile, camera: CameraSpec) -> Iterator[Finding]:
    source = profile.cameras[camera.camera]
    if camera.width is None or camera.height is None:
        return
    gives, asks = f"{source.width}x{source.height}", f"{camera.width}x{camera.height}"
    if camera.resize == "none" and gives != asks:
        yield error(
            "picture_size",
            f"camera {camera.camera!r} sends {gives}, the spec asks for {asks} and says "
            "resize: none",
        )
    stretch = (source.width * camera.height) / (source.height * camera.width)
    if camera.resize == "stretch" and abs(stretch - 1.0) > SHAPE_TOLERANCE:
        yield note(
            "picture_shape",
            f"camera {camera.camera!r}: {gives} is stretched to {asks}, out of shape by "
            f"{abs(stretch - 1.0):.0%}; right if it was trained so",
        )


def _timing(profile: Profile, spec: ModelSpec, rate_hz: float) -> Iterator[Finding]:
    chunk_s = spec.action.horizon * spec.action.dt_s
    if chunk_s * rate_hz < 1.0 - 1e-9:
        yield note(
            "gaps",
            f"a chunk lasts {chunk_s:g} s and one is asked for every {1 / rate_hz:g} s: the arm "
            "waits in between",
        )
    oldest_s = profile.timing.max_observation_age_s
    if spec.observation.max_age_s > oldest_s:
        yield warning(
            "camera_rate",
            f"the spec takes observations {spec.observation.max_age_s:g} s old, the command node "
            f"refuses chunks of those over {oldest_s:g} s (timing.max_observation_age_s)",
        )


def _task(profile: Profile, spec: ModelSpec, worker: str) -> Iterator[Finding]:
    if spec.action.gripper == "none" and profile.robot.finger_joints:
        yield note("no_gripper", f"robot {profile.robot.name!r} has a gripper, the model none")
    if spec.observation.prompt and not profile.task.prompt:
        yield warning("no_prompt", "needs a prompt; task.prompt of the profile is empty")
    if worker not in profile.workers:
        yield note(
            "not_listed",
            f"the profile's workers are {', '.join(profile.workers)}; `vla-zenoh up` will not "
            f"start {worker!r}",
        )


# -- a chunk --------------------------------------------------------------------------------------
def check_chunk(
    spec: ActionSpec, steps: Steps, limits: Limits, max_width_m: float
) -> list[Finding]:
    """Findings about the numbers of one chunk.

    Args:
        spec: the declared meaning of the numbers.
        steps: (H, D), as `vla_zenoh.policy.check_steps` gives them.
        limits: of the robot.
        max_width_m: of its gripper.
    """
    return [
        *_position(spec, steps[:, :3].astype(np.float64) * spec.position_scale_m, limits),
        *_rotation(spec, steps[:, 3 : 3 + ROTATION_SIZE[spec.rotation]].astype(float), limits),
        *_gripper(spec, steps[:, -1].astype(np.float64), max_width_m),
    ]


NEAR_RAD = 0.3
FAR_M = 0.1


def joints_as_pose(
    spec: ActionSpec, steps: Steps, joints_rad: NDArray[np.float64], limits: Limits
) -> list[Finding]:
    """An error if absolute poses look like joint positions, of which a step has as many numbers.

    Args:
        spec: the declared meaning of the numbers.
        steps: (H, D).
        joints_rad: (n,) of the arm at the observation.
        limits: of the robot.
    """
    count = len(joints_rad)
    if spec.kind != "absolute" or spec.dimension not in (count, count + 1):
        return []
    first = steps[:, :count].astype(np.float64)
    low, high = _corners(limits)
    position_m = steps[:, :3].astype(np.float64) * spec.position_scale_m
    outside_m = np.maximum(low - position_m, position_m - high).max(axis=1)
    away_rad = float(np.abs(first[0] - joints_rad).max())
    if away_rad > NEAR_RAD and float(outside_m.min()) <= FAR_M:
        return []
    like = (
        f"its first {count} numbers are within {away_rad:.2f} of the joints in rad"
        if away_rad <= NEAR_RAD
        else f"every pose is {float(outside_m.min()):.2f} m or more outside the workspace"
    )
    return [
        error(
            "joints_as_pose",
            f"declared as absolute poses (x, y, z, {spec.rotation}), but {like}, and a step has as "
            f"many numbers as this arm has joints: these are joint positions. Turn them into poses "
            "of the TCP, as vla_zenoh.interop.action_semantics.make_forward does",
        )
    ]


def beyond_joints(
    spec: ActionSpec,
    steps: Steps,
    jacobian: NDArray[np.float64],
    rotation: NDArray[np.float64],
) -> list[str]:
    """Axes along which a chunk of deltas asks an arm for what its joints cannot do, with amounts.

    Args:
        spec: the declared meaning of the numbers.
        steps: (H, D).
        jacobian: (6, n) of the TCP in base axes, linear first.
        rotation: (3, 3) of the TCP, for deltas in its frame.
    """
    if spec.kind != "delta" or jacobian.shape[1] >= POSE_JOINTS:
        return []
    asked = np.zeros(6)
    asked[:3] = steps[:, :3].sum(axis=0) * spec.position_scale_m
    asked[3:] = steps[:, 3:6].sum(axis=0) * (2.0 if spec.rotation == "quaternion" else 1.0)
    if spec.frame == "tcp":
        asked = np.concatenate([rotation @ asked[:3], rotation @ asked[3:]])
    scale = np.array([1.0] * 3 + [_LEVER_M] * 3)
    lost = float(np.linalg.norm(scale * lost_motion(jacobian, asked)))
    if lost <= LOST_SHARE * float(np.linalg.norm(scale * asked)):
        return []  # together the axes are one motion of the joints, as those of a model for it
    blocked = immovable_axes(jacobian)
    return [
        f"{name} ({value:+.3g} {'m' if index < 3 else 'rad'})"
        for index, (name, value) in enumerate(zip(AXES, asked.tolist(), strict=True))
        if name in blocked and abs(value) > (LEAST_M if index < 3 else LEAST_RAD)
    ]


LEAST_M, LEAST_RAD = 0.002, 0.01
"""Less than this of a chunk is noise."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Directions of a twist in base axes; roll, pitch and yaw are rotations about x, y and z."""
_LEVER_M = 0.3
"""A rotation of 1 rad counts as much as a motion of this length."""
LOST_SHARE = 0.3


def lost_motion(jacobian: NDArray[np.float64], twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of a twist (6,) m and rad that no velocity of the joints (6, n) gives."""
    scale = np.array([1.0] * 3 + [_LEVER_M] * 3)
    scaled = scale[:, None] * jacobian
    joints = np.linalg.lstsq(scaled, scale * twist, rcond=1e-6)[0]
    return twist - jacobian @ joints


def immovable_axes(jacobian: NDArray[np.float64]) -> tuple[str, ...]:
    """Axes along or about which the TCP cannot move without moving otherwise too."""
    scale = np.array([1.0] * 3 + [_LEVER_M] * 3)
    return tuple(
        name
        for index, name in enumerate(AXES)
        if float(np.linalg.norm(scale * lost_motion(jacobian, np.eye(6)[index])))
        > LOST_SHARE * scale[index]
    )


def _corners(limits: Limits) -> NDArray[np.float64]:
    """Lower and upper corner (2, 3) of the workspace box, m; this module does without Ruckig."""
    box = limits.workspace
    return np.array([box.x_m, box.y_m, box.z_m]).T


def _position(
    spec: ActionSpec, position_m: NDArray[np.float64], limits: Limits
) -> Iterator[Finding]:
    longest_m = float(np.linalg.norm(position_m, axis=1).max())
    if spec.kind == "absolute":
        if longest_m > REACH_M:
            yield error(
                "position_units",
                f"a pose {longest_m:.4g} m from the base, no arm here reaches over {REACH_M:g} m; "
                "are these metres? position_scale_m is "
                f"{spec.position_scale_m:g}",
            )
            return
        box = limits.workspace
        low, high = _corners(limits)
        outside_m = float(np.maximum(low - position_m, position_m - high).max())
        if outside_m > limits.step_m:
            yield warning(
                "workspace",
                f"a pose {outside_m:.3f} m outside the workspace x {box.x_m} y {box.y_m} "
                f"z {box.z_m}: is it in the base frame?",
            )
        return
    if longest_m > REJECT_FACTOR * limits.step_m:
        yield error(
            "position_units",
            f"a step of {longest_m:.4g} m, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_m:g} m; are these metres, and was the output unnormalised? "
            f"position_scale_m is {spec.position_scale_m:g}",
        )
        return
    if longest_m > limits.step_m * (1 + ROUNDING):
        yield warning(
            "step_limit", f"a step of {longest_m:.4g} m, the limit is {limits.step_m:g} m"
        )
    yield from _speed("m/s", longest_m, spec.dt_s, limits.translation.velocity_m_s)


def _rotation(spec: ActionSpec, rotation: NDArray[np.float64], limits: Limits) -> Iterator[Finding]:
    if spec.rotation == "quaternion":
        yield from _quaternion(spec, rotation, limits)
        return
    largest = float(np.linalg.norm(rotation, axis=1).max())
    if spec.kind == "absolute":
        if float(np.abs(rotation).max()) > 2 * math.pi:
            yield error(
                "rotation_units",
                f"an angle of {float(np.abs(rotation).max()):.4g}, more than a turn; give radians",
            )
        return
    yield from _turn(largest, spec, limits)


def _turn(largest_rad: float, spec: ActionSpec, limits: Limits) -> Iterator[Finding]:
    if largest_rad > REJECT_FACTOR * limits.step_rad:
        yield error(
            "rotation_units",
            f"a step of {largest_rad:.4g} rad, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_rad:g} rad; are these radians, and was the output unnormalised?",
        )
        return
    if largest_rad > limits.step_rad * (1 + ROUNDING):
        yield warning(
            "step_limit", f"a step of {largest_rad:.4g} rad, the limit is {limits.step_rad:g} rad"
        )
    yield from _speed("rad/s", largest_rad, spec.dt_s, limits.rotation.velocity_rad_s)


def _speed(unit: str, step: float, dt_s: float, limit: float) -> Iterator[Finding]:
    if step / dt_s > limit * (1 + 1e-3):
        yield warning(
            "speed_limit",
            f"a step of {step:.4g} in {dt_s:g} s is {step / dt_s:.3g} {unit}, the limit is "
            f"{limit:g}: the arm will come later than asked",
        )


def _quaternion(
    spec: ActionSpec, rotation: NDArray[np.float64], limits: Limits
) -> Iterator[Finding]:
    norms = np.linalg.norm(rotation, axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    if abs(worst - 1.0) > QUATERNION_NORM_TOLERANCE:
        yield error("quaternion", f"a quaternion of norm {worst:.4g}, wanted 1")
        return
    if spec.kind == "absolute":
        return
    turns = 2 * np.arccos(np.clip(np.abs(rotation[:, 3]), 0.0, 1.0))
    swapped = 2 * np.arccos(np.clip(np.abs(rotation[:, 0]), 0.0, 1.0))
    largest = float(turns.max())
    if largest > REJECT_FACTOR * limits.step_rad >= float(swapped.max()):
        yield error(
            "quaternion",
            f"a step of {largest:.4g} rad, which would be {float(swapped.max()):.4g} rad read as "
            "w, x, y, z; the order is x, y, z, w",
        )
        return
    yield from _turn(largest, spec, limits)


def _gripper(spec: ActionSpec, value: NDArray[np.float64], max_width_m: float) -> Iterator[Finding]:
    bounds = {
        "delta_m": (-max_width_m - GRIPPER_SLACK_M, max_width_m + GRIPPER_SLACK_M),
        "absolute_m": (-0.01, max_width_m + GRIPPER_SLACK_M),
        "open_fraction": (-GRIPPER_SLACK, 1.0 + GRIPPER_SLACK),
        "binary": (spec.gripper_threshold - BINARY_SPAN, spec.gripper_threshold + BINARY_SPAN),
    }
    if spec.gripper not in bounds:
        return
    low, high = bounds[spec.gripper]
    # Any number is a valid choice of two; the command node would reject the others.
    level = warning if spec.gripper == "binary" else error
    for found in (float(value.min()), float(value.max())):
        if not low <= found <= high:
            yield level(
                "gripper_range",
                f"gripper {found:.4g}, declared as {spec.gripper}: at most {low:.3g} to "
                f"{high:.3g} (this gripper opens to {max_width_m:g} m)",
            )
            return
