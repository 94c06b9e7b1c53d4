"""Errors of a model on a robot: a spec that the profile does not meet, chunks that cannot be meant.

No model runs here. Wrong units show in the size of the numbers: a step in millimetres or degrees is
far above what an arm may do, and above `vla_zenoh.profile.REJECT_FACTOR` times a limit the command
node rejects the chunk. What is worth a warning only is in `vla_zenoh.lab.check.fit`. An arm that
obeys rejects a chunk for one reason at a time, which has a short name and a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import (
    FURTHEST_RAD,
    Steps,
    as_deltas,
    gripper_range,
    rotation_of,
    step_width,
    with_quaternions,
)
from vla_zenoh.control.limits import workspace_corners
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.errors import RecordError, SpecError
from vla_zenoh.kinematics.so3 import log3
from vla_zenoh.policy import ActionSpec, ModelSpec, check_steps
from vla_zenoh.profile import POSE_JOINTS, REACH_M, REJECT_FACTOR, Limits, Profile
from vla_zenoh.types import (
    QUATERNION_NORM_TOLERANCE,
    ActionChunk,
    FloatArray,
    JointBound,
    Stamped,
    Task,
)

FUTURE_TOLERANCE_NS = 50_000_000
"""Clocks of two hosts may differ by this; more says that a clock was set."""
ROUNDING = 1e-6
"""Chunks are float32: a step of exactly the limit is within it."""
SOURCE_CHARS = 60
"""A source is foreign text, and a sentence has to stay readable."""


class Finding(NamedTuple):
    """One result of a check: a stable short name, and a sentence with what is found and expected.

    ``error``: the model must not get the arm; ``warning``: look at it.
    """

    level: Literal["error", "warning", "note"]
    name: str
    why: str


def error(name: str, why: str) -> Finding:
    """A finding that keeps the model from the arm."""
    return Finding("error", name, why)


# -- the spec -------------------------------------------------------------------------------------
RATE_TOLERANCE = 0.1
"""Share by which chunks per second may differ from the steps that a model counts."""


def wrong_rate(spec: ModelSpec, rate_hz: float) -> str:
    """Why a model that counts inferences as steps cannot be asked at `rate_hz`; empty: it can."""
    step_hz = 1.0 / spec.action.dt_s
    if not spec.every_step or abs(rate_hz - step_hz) <= RATE_TOLERANCE * step_hz:
        return ""
    return (
        f"it counts each inference as a step of {spec.action.dt_s:.4g} s (dt_s), as it was trained,"
        f" and is asked every {1.0 / rate_hz:.4g} s: set {step_hz:.4g} chunks per second "
        f"(`vla-zenoh rate {step_hz:.4g}`, task.rate_hz)"
    )


def spec_errors(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    """Requirements of a spec that the profile does not meet."""
    seen = spec.observation
    for name in seen.camera_names:
        if name not in profile.cameras:
            given = ", ".join(profile.cameras) or "none"
            yield error(
                "camera",
                f"needs camera {name!r}, the profile has: {given}; add it to cameras, or name "
                "another in the model's options",
            )
    for wanted in seen.depth:
        camera = profile.cameras.get(wanted.camera)
        if camera is not None and camera.depth_unit_m is None:
            yield error(
                "depth",
                f"needs the depth of camera {wanted.camera!r}, which has none; set "
                f"cameras.{wanted.camera}.depth_unit_m, if it measures depth",
            )
    for wanted in (*seen.cameras, *seen.depth):
        camera = profile.cameras.get(wanted.camera)
        if camera is None:
            continue
        gives, asks = f"{camera.width}x{camera.height}", f"{wanted.width}x{wanted.height}"
        if wanted.resize == "none" and wanted.width is not None and gives != asks:
            yield error(
                "picture_size",
                f"camera {wanted.camera!r} sends {gives}, the spec asks for {asks} and says "
                "resize: none",
            )
        apart_s = min(seen.max_skew_s, (seen.history_spacing_s or math.inf) / 2)
        if seen.history > 1 and apart_s * camera.rate_hz < 0.5:
            yield error(
                "history_rate",
                f"camera {wanted.camera!r} gives an image every {1 / camera.rate_hz:.3f} s, the "
                f"spec's history allows none further than {apart_s:g} s from its time",
            )
        if seen.max_age_s * camera.rate_hz < 1.0:
            yield error(
                "camera_rate",
                f"camera {wanted.camera!r} gives an image every {1 / camera.rate_hz:.2f} s, the "
                f"spec allows none older than {seen.max_age_s:g} s",
            )
    if set(spec.parts) != set(profile.part_names):
        names = [", ".join(filter(None, each)) for each in (spec.parts, profile.part_names)]
        yield error(
            "parts",
            f"its columns are for {names[0] or 'one arm'}; robot {profile.robot.name!r} is "
            f"{names[1] or 'one arm'}: name these in ActionSpec.of_parts",
        )
        return
    for part in spec.parts:
        yield from _action_errors(profile.of_part(part), spec.action.of(part))


def _action_errors(profile: Profile, action: ActionSpec) -> Iterator[Finding]:
    if action.gripper != "none" and profile.robot.no_gripper:
        yield error(
            "gripper",
            f"acts on a gripper (gripper: {action.gripper}), and {profile.robot.no_gripper}: use a "
            'model of the arm alone, with gripper="none" and no number for it',
        )
    if action.space == "joint":
        wanted, given = set(profile.robot.arm_joints), set(action.joints)
        if wanted != given:
            yield error(
                "joint_names",
                f"its joints are {', '.join(action.joints)}; robot {profile.robot.name!r} "
                f"has {', '.join(profile.robot.arm_joints)}: name these, in the order of the "
                "model's columns",
            )
        if profile.robot.command == "pose" and len(profile.robot.arm_joints) < POSE_JOINTS:
            yield error(
                "too_few_joints",
                f"{few_joints(profile)}, and its robot takes poses: set robot.command to joint",
            )
    elif action.kind == "absolute" and len(profile.robot.arm_joints) < POSE_JOINTS:
        yield error(
            "too_few_joints",
            f"{few_joints(profile)}: it cannot go straight from one absolute pose to the next; "
            "use a model whose actions are joints (space joint) or deltas",
        )


def joints_by_pose(profile: Profile, action: ActionSpec) -> str:
    """A sentence where the joints of an action are not what the robot is commanded; else empty."""
    of_parts = {each.part: each.action for each in action.parts} or {"": action}
    if all(
        each.space != "joint" or profile.of_part(part).robot.command == "joint"
        for part, each in of_parts.items()
        if part in profile.part_names
    ):
        return ""
    return (
        "the actions are joints and this robot is commanded by poses: its TCP goes where these "
        "joints bring it, each joint may be elsewhere; with `robot: {command: joint}` it follows "
        "the joints themselves"
    )


def few_joints(profile: Profile) -> str:
    """Beginning of a sentence about an arm with fewer joints than a pose needs."""
    robot = profile.robot
    return (
        f"robot {robot.name!r} has {len(robot.arm_joints)} arm joints, a pose of the TCP needs six"
    )


# -- a chunk --------------------------------------------------------------------------------------
def chunk_errors(
    spec: ActionSpec,
    steps: Steps,
    limits: Limits,
    max_width_m: float,
    sliding: Collection[str] = (),
) -> Iterator[Finding]:
    """Numbers (H, D) of one chunk, from `check_steps`, that cannot have the declared meaning.

    Of its joints those in `sliding` slide, as far as it is known.
    """
    steps = steps.astype(np.float64)
    wanted = gripper_range(spec, max_width_m)
    for why in beyond_gripper(spec, steps[:, -1], wanted, max_width_m):
        yield error("gripper_range", why)
    if spec.space == "joint":
        beyond = beyond_joint_units(spec, steps, limits, np.isin(spec.joints, [*sliding]))
        if beyond is not None:
            yield error("joint_units", beyond.why)
        return
    wrote_6d = spec.rotation == "rotation_6d"
    try:
        spec, steps = with_quaternions(spec, steps)
    except RecordError as fault:
        yield error("rotation_6d", str(fault))
        return
    rotation = steps[:, spec.rotation_columns]
    if spec.rotation == "quaternion":
        worst = max(np.linalg.norm(rotation, axis=1).tolist(), key=lambda norm: abs(norm - 1.0))
        if abs(worst - 1.0) > QUATERNION_NORM_TOLERANCE:
            yield error("quaternion", f"a quaternion of norm {worst:.4g}, wanted 1")
            return
    longest_m, most_rad = largest_step(spec, steps)
    if spec.kind == "absolute" and longest_m > REACH_M:
        yield error(
            "position_units",
            f"a pose {longest_m:.4g} m from the base, no arm here reaches over {REACH_M:g} m; are "
            f"these metres? position_scale_m is {spec.position_scale_m:g}",
        )
    if spec.kind != "absolute" and longest_m > REJECT_FACTOR * limits.step_m:
        yield error(
            "position_units",
            f"a step of {longest_m:.4g} m, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_m:g} m; are these metres, and was the output unnormalised? "
            f"position_scale_m is {spec.position_scale_m:g}",
        )
    too_far_rad = REJECT_FACTOR * limits.step_rad
    if spec.rotation == "quaternion" and not spec.targets and not wrote_6d:
        most_rad, swapped_rad = (
            2 * math.acos(min(float(np.abs(rotation[:, index]).min()), 1.0)) for index in (3, 0)
        )
        if swapped_rad <= too_far_rad < most_rad:
            yield error(
                "quaternion",
                f"a step of {most_rad:.4g} rad, which would be {swapped_rad:.4g} rad read as "
                "w, x, y, z; the order is x, y, z, w",
            )
            return
    if spec.targets and (largest := float(np.abs(rotation).max())) > 2 * math.pi:
        yield error("rotation_units", f"an angle of {largest:.4g}, more than a turn; give radians")
    elif spec.kind != "absolute" and most_rad > too_far_rad:
        yield error(
            "rotation_units",
            f"a step of {most_rad:.4g} rad, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_rad:g} rad; are these radians, and was the output unnormalised?",
        )


def largest_step(spec: ActionSpec, steps: Steps) -> tuple[float, float]:
    """Largest length (m) and angle (rad) from one step to the next; of absolute poses their own."""
    spec, steps = as_deltas(spec, steps)
    position_m = steps[:, :3] * spec.position_scale_m
    rotation = steps[:, spec.rotation_columns]
    angles = np.linalg.norm(rotation, axis=1)
    if spec.rotation == "quaternion":
        angles = 2 * np.arccos(np.clip(np.abs(rotation[:, 3]), 0.0, 1.0))
    return float(np.linalg.norm(position_m, axis=1).max()), float(angles.max())


def beyond_joint_units(
    spec: ActionSpec, steps: Steps, limits: Limits, slides: NDArray[np.bool_]
) -> Rejection | None:
    """Why joints (H, D) are too far for radians, or for metres where they slide, true in (n,)."""
    scale = spec.dt_s if spec.kind == "velocity" else 1.0
    mosts = REJECT_FACTOR * JointBound(limits.step_rad, limits.step_m).of(slides)
    if spec.targets:
        mosts = np.full(len(slides), FURTHEST_RAD)  # or m: the arm's own ranges are checked next
    if spec.kind == "absolute" and spec.turns == "counted":
        return None
    largest = scale * np.abs(steps[:, : spec.arm_size]).max(axis=0)
    worst = int(np.argmax(largest / mosts))
    far, most = float(largest[worst]), float(mosts[worst])
    if far <= most:
        return None
    what = "a target" if spec.targets else "a step"
    if slides[worst]:
        why = f"{what} of a joint of {far:.4g} m, at most {most:.4g}; are these metres?"
        return Rejection("step_m", why, far, most)
    why = f"{what} of a joint of {far:.4g} rad, at most {most:.4g}; are these radians?"
    return Rejection("step_rad", why, far, most)


def beyond_gripper(
    spec: ActionSpec, value: FloatArray, wanted: tuple[float, float], max_width_m: float
) -> Iterator[str]:
    """A sentence about gripper numbers (n,) that are not in a range that is wanted of them."""
    low, high = wanted
    outside = value[(value < low) | (value > high)].tolist()
    if outside:
        yield (
            f"gripper {outside[0]:.4g}, declared as {spec.gripper}: at most {low:.3g} to "
            f"{high:.3g} (this gripper opens to {max_width_m:g} m)"
        )


# -- joints ----------------------------------------------------------------------------------------
FAR_M = 0.1
NEAR = JointBound(0.3, FAR_M)
"""Numbers this near to the joints, and as a pose this far from the TCP, are joints."""
LEAST_M, LEAST_RAD = 0.002, 0.01
"""Less than this of a chunk is noise."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Directions of a twist in base axes; roll, pitch and yaw are rotations about x, y and z."""
_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
"""A rotation of 1 rad counts as much as a motion of 0.3 m."""
LOST_SHARE = 0.3
"""Part of the motion asked for that joints may leave out: less is the curve of their path."""


def joints_as_pose(
    spec: ActionSpec,
    steps: Steps,
    joints_rad: FloatArray,
    slides: NDArray[np.bool_],
    limits: Limits,
) -> list[Finding]:
    """An error if absolute poses look like joints, of which a step (H, D) has as many numbers.

    The joints (n,) of the arm are those at the observation; of them these slide.
    """
    count = len(joints_rad)
    absolute = spec.space != "joint" and spec.kind == "absolute"
    if not absolute or spec.dimension not in (count, count + 1):
        return []
    outside_m = float(outside_workspace_m(spec, steps, limits).min())
    away = np.abs(steps[0, :count].astype(np.float64) - joints_rad)
    if (away <= NEAR.of(slides)).all():
        like = f"its first {count} numbers are within {away.max():.2f} of the joints in rad or m"
    elif outside_m > FAR_M:
        like = f"every pose is {outside_m:.2f} m or more outside the workspace"
    else:
        return []
    return [
        error(
            "joints_as_pose",
            f"declared as absolute poses (x, y, z, {spec.rotation}), but {like}, and a step has as "
            "many numbers as this arm has joints: these are joint positions. Declare them as "
            "space='joint' with joints=(the arm's joint names, in the order of the columns)",
        )
    ]


def beyond_joints(
    spec: ActionSpec, steps: Steps, jacobian: FloatArray, rotation: FloatArray
) -> list[str]:
    """Axes along which deltas (H, D) ask an arm for what its joints cannot do, with amounts.

    The Jacobian (6, n) of the TCP is in base axes, linear first; deltas may be in its frame, of
    that `rotation` (3, 3).
    """
    if spec.space == "joint" or spec.kind == "absolute" or jacobian.shape[1] >= POSE_JOINTS:
        return []
    spec, steps = as_deltas(spec, steps)
    asked = np.zeros(6)
    asked[:3] = steps[:, :3].sum(axis=0) * spec.position_scale_m
    turns = steps[:, 3:6]
    if spec.rotation == "quaternion":  # of small turns, with either sign
        turns = np.copysign(2.0, steps[:, 6:7]) * turns
    asked[3:] = turns.sum(axis=0)
    if spec.frame == "tcp":
        asked = np.concatenate([rotation @ asked[:3], rotation @ asked[3:]])
    if _lost(jacobian, asked) <= LOST_SHARE * float(np.linalg.norm(_WEIGHTS * asked)):
        return []  # together the axes are one motion of the joints, as those of a model for it
    blocked = immovable_axes(jacobian)
    return [
        f"{name} ({value:+.3g} {'m' if index < 3 else 'rad'})"
        for index, (name, value) in enumerate(zip(AXES, asked.tolist(), strict=True))
        if name in blocked and abs(value) > (LEAST_M if index < 3 else LEAST_RAD)
    ]


def _lost(jacobian: FloatArray, twist: FloatArray) -> float:
    """Size of the part of a twist (6,) m and rad that no velocity of the joints (6, n) gives."""
    joints = np.linalg.lstsq(_WEIGHTS[:, None] * jacobian, _WEIGHTS * twist, rcond=1e-6)[0]
    return float(np.linalg.norm(_WEIGHTS * (twist - jacobian @ joints)))


def immovable_axes(jacobian: FloatArray) -> tuple[str, ...]:
    """Axes along or about which the TCP cannot move without other motion."""
    return tuple(
        name
        for index, name in enumerate(AXES)
        if _lost(jacobian, np.eye(6)[index]) > LOST_SHARE * _WEIGHTS[index]
    )


def outside_workspace_m(spec: ActionSpec, steps: Steps, limits: Limits) -> FloatArray:
    """(H,) m from absolute targets to the workspace box along the worst axis; inside below 0."""
    low, high = workspace_corners(limits)
    position_m = steps[:, :3].astype(np.float64) * spec.position_scale_m
    return np.maximum(low - position_m, position_m - high).max(axis=1)


# -- rejecting a chunk -----------------------------------------------------------------------------
class Rejection(NamedTuple):
    """Why a chunk is not executed, or a setting not applied: a stable name and a sentence.

    With the value found and the one allowed, where they are numbers. ``quiet``: part of normal
    operation (a chunk on its way while the prompt changed), no event.
    """

    reason: str
    why: str
    value: float | None = None
    limit: float | None = None
    quiet: bool = False


@dataclass(slots=True)
class Lease:
    """The right of one worker to move the arm, as agreed at activation.

    Args:
        spec: the worker's spec.
        source: the only source whose chunks count, not another process of the same name.
        since_ns: observations older than this were taken before the arm was given to the worker.
        last_seq: sequence number of the newest chunk received.
        last_observation_ns: observation of the newest chunk accepted.
    """

    spec: ModelSpec
    source: str
    since_ns: int
    last_seq: int = -1
    last_observation_ns: int = -1


def validate_chunk(
    chunk: Stamped[ActionChunk],
    owner: str | None,
    lease: Lease | None,
    task: Task,
    max_age_s: float,
    now_ns: int,
) -> Rejection | None:
    """The first reason to reject `chunk`, None for a valid one.

    Updates `lease`, so that each sequence number and each observation is accepted once.

    Args:
        chunk: as received.
        owner: the source that published the spec of the chunk's worker; None: no spec yet.
        lease: of that worker; None: it does not move the arm, and only the source is checked.
        task: the task in force.
        max_age_s: oldest observation allowed.
        now_ns: wall time.
    """
    record, header = chunk.record, chunk.header
    if owner is None:
        return Rejection("unknown_worker", "its spec is not known yet", quiet=True)
    expected = owner if lease is None or header.source != owner else lease.source
    if header.source != expected:
        return Rejection(
            "foreign",
            f"chunk of worker {record.worker!r} by {header.source[:SOURCE_CHARS]!r}; the source of "
            f"this worker is {expected[:SOURCE_CHARS]!r}",
        )
    if lease is None:
        return None
    if header.seq <= lease.last_seq:
        why = f"chunk {header.seq} came twice or out of order"
        return Rejection("replayed", why, header.seq, lease.last_seq)
    lease.last_seq = header.seq
    agreed = lease.spec.hash
    if record.spec_hash != agreed:
        why = f"chunk of spec {record.spec_hash!r}, agreed at activation was {agreed}"
        return Rejection("spec_mismatch", why)
    if record.episode != task.episode:
        return Rejection(
            "superseded",
            f"chunk for episode {record.episode}, the current one is {task.episode}",
            record.episode,
            task.episode,
            quiet=record.episode < task.episode,
        )
    age_s = (now_ns - record.observation_stamp_ns) / 1e9
    if age_s < -FUTURE_TOLERANCE_NS / 1e9:
        return Rejection("future", f"its observation is {-age_s:.3f} s in the future", age_s, 0.0)
    if record.observation_stamp_ns < lease.since_ns:
        why = "its observation was taken before this activation"
        return Rejection("before_activation", why, quiet=True)
    if age_s > max_age_s:
        why = f"its observation is {age_s:.3f} s old, at most {max_age_s:g} s"
        return Rejection("stale", why, age_s, max_age_s)
    if now_ns > record.valid_until_ns:
        late_s = (now_ns - record.valid_until_ns) / 1e9
        return Rejection("expired", f"it was valid until {late_s:.3f} s ago", late_s, 0.0)
    if record.observation_stamp_ns <= lease.last_observation_ns:
        return Rejection("out_of_order", "its observation is not newer than the last one used")
    try:
        check_steps(lease.spec.action, record.steps)
    except SpecError as error:
        return Rejection("shape", str(error))
    lease.last_observation_ns = record.observation_stamp_ns
    return None


def validate_steps(
    action: ActionSpec,
    steps: FloatArray,
    start: Goal,
    limits: Limits,
    max_width_m: float,
    slides: NDArray[np.bool_],
) -> Rejection | None:
    """Why numbers (n, D) are impossible for steps of this meaning, None if all are possible.

    All steps are checked before the arm follows the first one, which starts from `start`. The
    joints of their columns that slide are true in `slides`.
    """
    try:
        for step in steps if action.gripper != "none" else ():
            step_width(action, step, start.width_m, max_width_m)
        if action.space == "joint":
            return beyond_joint_units(action, steps, limits, slides)
        action, steps = with_quaternions(action, steps)
        rotations = steps[:, action.rotation_columns]
        if action.rotation == "quaternion":
            off = np.abs(np.linalg.norm(rotations, axis=1) - 1.0)
            for index in (off > 0.9 * QUATERNION_NORM_TOLERANCE).nonzero()[0]:
                rotation_of(action, rotations[index])
    except RecordError as error:
        return Rejection("meaning", str(error))
    if action.kind == "absolute":
        return _validate_targets(steps[:, :3] * action.position_scale_m, limits)
    action, steps = as_deltas(action, steps)
    ways_m = np.linalg.norm(steps[:, :3] * action.position_scale_m, axis=1)
    turns = [log3(rotation_of(action, numbers)) for numbers in steps[:, action.rotation_columns]]
    turns_rad = np.linalg.norm(turns, axis=1)
    for name, sizes, limit in (
        ("step_m", ways_m, limits.step_m),
        ("step_rad", turns_rad, limits.step_rad),
    ):
        beyond = ~(sizes <= REJECT_FACTOR * limit)  # true of what is no number
        if beyond.any():
            size = float(sizes[beyond][0])
            why = (
                f"a step of {size:.4g} is over {REJECT_FACTOR:g} times its limit; "
                "is its unit right?"
            )
            return Rejection(name, why, size, limit)
    return None


def _validate_targets(positions_m: FloatArray, limits: Limits) -> Rejection | None:
    """Why absolute targets (n, 3) are too far outside the workspace box to be intended."""
    most_m = REJECT_FACTOR * limits.step_m
    away_m = np.linalg.norm(positions_m - np.clip(positions_m, *workspace_corners(limits)), axis=1)
    for index in (away_m > most_m).nonzero()[0]:
        at = ", ".join(f"{value:.4g}" for value in positions_m[index])
        why = (
            f"a target at ({at}) m, {away_m[index]:.4g} m outside the workspace "
            f"{limits.tcp_box}: are its numbers metres (position_scale_m), and is it in the base "
            "frame?"
        )
        return Rejection("workspace", why, float(away_m[index]), most_m)
    return None
