"""Fit of a model to a profile, and plausibility of its chunks: errors, warnings and notes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import chunk_poses
from vla_zenoh.control.limits import ROTATION_BOX
from vla_zenoh.control.policy_check import (
    Finding,
    Steps,
    beyond_gripper,
    chunk_errors,
    error,
    few_joints,
    joints_by_pose,
    largest_step,
    outside_workspace_m,
    spec_errors,
    wrong_rate,
)
from vla_zenoh.kinematics.description import sliding_joints
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.profile import POSE_JOINTS, REACH_M, REJECT_FACTOR, Limits, Profile, RobotProfile
from vla_zenoh.types import JointBound

SHAPE_TOLERANCE = 0.02
"""An image may be stretched by this share of its aspect ratio without a note."""
ROUNDING = 1e-6
BINARY_SPAN = 2.0
"""A number further than this from the threshold is not a choice of two but another quantity."""
ORIGIN = Pose(np.zeros(3), np.eye(3))


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
        rate_hz: chunks per second requested; None: by the profile.
    """
    return [
        *spec_errors(profile, spec),
        *_cameras(profile, spec),
        *_timing(profile, spec, rate_hz or profile.task.rate_hz),
        *_robot(profile, spec, worker),
    ]


def _cameras(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    wanted = spec.observation
    known = [camera for camera in wanted.cameras if camera.camera in profile.cameras]
    for camera in known:
        yield from _shape(profile, camera)
    slowest = min((profile.cameras[camera.camera].rate_hz for camera in known), default=0.0)
    if len(known) > 1 and wanted.max_skew_s * slowest < 1.0:
        yield warning(
            "camera_rate",
            f"at {slowest:g} Hz images may lie {1 / slowest:.3f} s apart, the spec allows "
            f"{wanted.max_skew_s:g} s: many observations will be rejected",
        )


def _shape(profile: Profile, camera: CameraSpec) -> Iterator[Finding]:
    source = profile.cameras[camera.camera]
    if camera.resize != "stretch" or camera.width is None or camera.height is None:
        return
    stretch = (source.width * camera.height) / (source.height * camera.width)
    if abs(stretch - 1.0) > SHAPE_TOLERANCE:
        yield note(
            "picture_shape",
            f"camera {camera.camera!r}: {source.width}x{source.height} is stretched to "
            f"{camera.width}x{camera.height}, out of shape by {abs(stretch - 1.0):.0%}; right if "
            "it was trained so",
        )


def _timing(profile: Profile, spec: ModelSpec, rate_hz: float) -> Iterator[Finding]:
    chunk_s = spec.action.horizon * spec.action.dt_s
    if chunk_s * rate_hz < 1.0 - 1e-9:
        yield note(
            "gaps",
            f"a chunk lasts {chunk_s:g} s and one is asked for every {1 / rate_hz:g} s: the arm "
            "waits in between",
        )
    if spec.action.horizon == 1 and spec.action.kind == "delta" and chunk_s * rate_hz > 1.0 + 1e-9:
        yield warning(
            "rushes",
            f"a delta is to take {chunk_s:g} s and one is asked for every {1 / rate_hz:g} s: each "
            "is a whole step, so the arm goes faster than the model was made for",
        )
    if why := wrong_rate(spec, rate_hz):
        yield error("rate", why)
    oldest_s = profile.timing.max_observation_age_s
    if spec.observation.max_age_s > oldest_s:
        yield warning(
            "camera_rate",
            f"the spec takes observations {spec.observation.max_age_s:g} s old, the command node "
            f"rejects chunks of those over {oldest_s:g} s (timing.max_observation_age_s)",
        )


def _robot(profile: Profile, spec: ModelSpec, worker: str) -> Iterator[Finding]:
    if why := joints_by_pose(profile, spec.action):
        yield warning("joints_by_pose", why)
    few = len(profile.robot.arm_joints) < POSE_JOINTS
    if spec.action.space == "tcp" and spec.action.kind != "absolute" and few:
        yield warning(
            "too_few_joints",
            f"{few_joints(profile)}: steps that it has no joint for are shortened, to nothing at "
            "worst (limit reach); `vla-zenoh profile check` names the axes",
        )
    if spec.action.gripper == "none" and profile.robot.gripper is not None:
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
    spec: ActionSpec,
    steps: Steps,
    limits: Limits,
    max_width_m: float,
    robot: RobotProfile | None = None,
) -> list[Finding]:
    """Findings about the numbers of one chunk.

    Args:
        steps: (H, D), as `vla_zenoh.policy.check_steps` gives them.
        robot: whose joints they move; None: not known.
    """
    sliding = () if robot is None else sliding_joints(robot)
    found = list(chunk_errors(spec, steps, limits, max_width_m, sliding))
    if {"quaternion", "rotation_6d"} & {each.name for each in found}:
        return found  # there is no pose to look at
    if spec.space == "joint":
        names = () if robot is None else robot.arm_joints
        fast = dict(zip(names, limits.joint.of("velocity_rad_s", len(names)), strict=True))
        found += _joint_steps(spec, steps, limits, np.isin(spec.joints, [*sliding]), fast)
    elif spec.kind == "absolute":
        found += _targets(spec, steps, limits)
    else:
        found += _steps(spec, steps, limits)
    if spec.gripper == "binary":
        value = steps[:, -1].astype(np.float64)
        choice = spec.gripper_threshold - BINARY_SPAN, spec.gripper_threshold + BINARY_SPAN
        beyond = beyond_gripper(spec, value, choice, max_width_m)
        found += (warning("gripper_range", why) for why in beyond)
    return found


def _targets(spec: ActionSpec, steps: Steps, limits: Limits) -> Iterator[Finding]:
    longest_m, _ = largest_step(spec, steps)
    outside_m = float(outside_workspace_m(spec, steps, limits).max())
    if longest_m <= REACH_M and outside_m > limits.step_m:
        yield warning(
            "workspace",
            f"a pose {outside_m:.3f} m outside the workspace {limits.tcp_box}: is it in "
            "the base frame?",
        )


def _joint_steps(
    spec: ActionSpec,
    steps: Steps,
    limits: Limits,
    slides: NDArray[np.bool_],
    fast: Mapping[str, float],
) -> Iterator[Finding]:
    """As `_steps`, of the joint that is fastest for its limit: by name in `fast`, or the least."""
    joints = np.asarray(steps[:, : spec.arm_size], np.float64)
    if spec.kind == "velocity":
        joints = joints * spec.dt_s
    elif spec.targets:
        joints = np.diff(joints, axis=0)
        if spec.turns == "wrapped":  # more than half a turn is a step over pi
            joints = wrapped(joints)
    ways = np.abs(joints).max(axis=0, initial=0.0)
    units = np.where(slides, "m", "rad")
    most = JointBound(limits.step_rad, limits.step_m).of(slides)
    worst = int(np.argmax(ways / most))
    if (not spec.targets) and ways[worst] > most[worst] * (1 + ROUNDING):
        if ways[worst] > REJECT_FACTOR * most[worst]:
            return  # an error
        unit = units[worst]
        yield warning(
            "step_limit",
            f"a step of a joint of {ways[worst]:.4g} {unit}, the limit is {most[worst]:g} {unit}",
        )
    least = min(limits.joint.velocity_rad_s)
    most = np.array([fast.get(name, least) for name in spec.joints])
    worst = int(np.argmax(ways / most))
    speed = float(ways[worst]) / spec.dt_s
    if speed > most[worst] * (1 + 1e-3):
        unit = units[worst]
        yield warning(
            "speed_limit",
            f"a joint moves by {ways[worst]:.4g} {unit} in {spec.dt_s:g} s, {speed:.3g} {unit}/s; "
            f"its limit is {most[worst]:g}: the arm may come later than asked",
        )


def _steps(spec: ActionSpec, steps: Steps, limits: Limits) -> Iterator[Finding]:
    longest_m, most_rad = largest_step(spec, steps)
    if spec.controller is not None:  # the arm covers less than that
        poses = [ORIGIN, *chunk_poses(spec, steps, ORIGIN)]
        ways = [pose_distance(before, after) for before, after in pairwise(poses)]
        longest_m, most_rad = map(max, zip(*ways, strict=True))
    turn_rad_s = ROTATION_BOX * limits.rotation.velocity_rad_s
    for step, unit, most, speed, where in (
        (longest_m, "m", limits.step_m, limits.translation.velocity_m_s, ""),
        (most_rad, "rad", limits.step_rad, turn_rad_s, " about an axis of the base"),
    ):
        if step > REJECT_FACTOR * most:
            continue  # an error
        if step > most * (1 + ROUNDING):
            yield warning(
                "step_limit", f"a step of {step:.4g} {unit}, the limit is {most:g} {unit}"
            )
        if step / spec.dt_s > speed * (1 + 1e-3):
            yield warning(
                "speed_limit",
                f"a step of {step:.4g} in {spec.dt_s:g} s is {step / spec.dt_s:.3g} {unit}/s, the "
                f"limit is {speed:g}{where}: the arm will come later than asked",
            )
