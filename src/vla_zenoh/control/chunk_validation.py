"""Validation of action chunks: every reason to reject one has a short name and a sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.actions import as_deltas, rotation_of, step_pose, step_width
from vla_zenoh.control.limits import bound_step, workspace_corners
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.policy_check import beyond_radians
from vla_zenoh.errors import RecordError, SpecError
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, ModelSpec, check_steps
from vla_zenoh.profile import REJECT_FACTOR, Limits
from vla_zenoh.types import QUATERNION_NORM_TOLERANCE, ActionChunk, FloatArray, Stamped, Task

FUTURE_TOLERANCE_NS = 50_000_000
ROUNDING = 1e-6
SOURCE_CHARS = 60


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
    rejection = _validate_times(record, lease, max_age_s, now_ns)
    if rejection is not None:
        return rejection
    try:
        check_steps(lease.spec.action, record.steps)
    except SpecError as error:
        return Rejection("shape", str(error))
    lease.last_observation_ns = record.observation_stamp_ns
    return None


def _validate_times(
    record: ActionChunk, lease: Lease, max_age_s: float, now_ns: int
) -> Rejection | None:
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
    return None


def validate_steps(
    action: ActionSpec, steps: FloatArray, start: Goal, limits: Limits, max_width_m: float
) -> Rejection | None:
    """Why numbers (n, D) are impossible for steps of this meaning, None if all are possible.

    All steps are checked before the arm follows the first one, which starts from `start`.
    """
    rotations = steps[:, 3 : 3 + ROTATION_SIZE[action.rotation]]
    try:
        for step in steps if action.gripper != "none" else ():
            step_width(action, step, start.width_m, max_width_m)
        if action.space == "joint":
            beyond = beyond_radians(action, steps, limits)
            return None if beyond is None else Rejection("step_rad", *beyond)
        if action.rotation == "quaternion":
            off = np.abs(np.linalg.norm(rotations, axis=1) - 1.0)
            for index in (off > 0.9 * QUATERNION_NORM_TOLERANCE).nonzero()[0]:
                rotation_of(action, rotations[index])
    except RecordError as error:
        return Rejection("meaning", str(error))
    if action.kind == "absolute":
        return _validate_targets(steps[:, :3] * action.position_scale_m, limits)
    action, steps = as_deltas(action, steps)
    rotations = steps[:, 3 : 3 + ROTATION_SIZE[action.rotation]]
    lengths_m = steps[:, :3] * action.position_scale_m
    if action.rotation == "quaternion":
        most_rad = 2.0 * np.arccos(np.clip(np.abs(rotations[:, 3]) - ROUNDING, 0.0, 1.0))
    else:  # three angles, or one: together at most as large as this
        most_rad = np.abs(rotations).sum(axis=1)
    most_m = np.abs(lengths_m).sum(axis=1)
    suspect = most_m > limits.step_m * REJECT_FACTOR * (1 - ROUNDING)
    suspect |= most_rad > limits.step_rad * REJECT_FACTOR * (1 - ROUNDING)
    for index in suspect.nonzero()[0]:
        asked = step_pose(action, steps[index], start.pose)
        for hit in bound_step(limits, start.pose, asked)[1]:
            if hit.fatal:
                why = (
                    f"a step of {hit.value:.4g} is over {REJECT_FACTOR:g} times its limit; "
                    "is its unit right?"
                )
                return Rejection(hit.name, why, hit.value, hit.limit)
    return None


def _validate_targets(positions_m: FloatArray, limits: Limits) -> Rejection | None:
    """Why absolute targets (n, 3) are too far outside the workspace box to be intended."""
    box, most_m = limits.workspace, REJECT_FACTOR * limits.step_m
    away_m = np.linalg.norm(positions_m - np.clip(positions_m, *workspace_corners(limits)), axis=1)
    for index in (away_m > most_m).nonzero()[0]:
        at = ", ".join(f"{value:.4g}" for value in positions_m[index])
        why = (
            f"a target at ({at}) m, {away_m[index]:.4g} m outside the workspace x {box.x_m} "
            f"y {box.y_m} z {box.z_m}: are its numbers metres (position_scale_m), and is it in "
            "the base frame?"
        )
        return Rejection("workspace", why, float(away_m[index]), most_m)
    return None
