"""Difference between two workers' actions for the same observation and the same time ahead.

Chunks are paired by the time of their observation. Both are integrated from the pose that the arm
had then, up to the end of the shorter one, so workers of any spec can be compared: deltas with
absolute poses, one step with fifty.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.actions import Steps, chunk_poses, step_joints, step_width
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, interpolate, log3, pose_of
from vla_zenoh.lab.recording.run import Run, nearest
from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import ActionChunk, FloatArray

AXES = ("x", "y", "z", "rx", "ry", "rz")
DEFAULT_TOLERANCE_S = 0.06
"""Two frames at 30 Hz: observations this close in time show the same."""
MOVES_M = 1e-3
"""A smaller requested displacement has no direction."""
GRIPPER_SHARE = 0.25
"""Share of the gripper's width by which two requests must differ to count as different."""


class ArmState(NamedTuple):
    """Measured pose and opening of the gripper, and the joints (n,) in the order of the arm.

    Without joints, actions in joints cannot be compared.
    """

    pose: Pose
    width_m: float
    joints_rad: FloatArray | None = None


def arm_state(run: Run, stamp_ns: int, arm: Kinematics | None = None) -> ArmState:
    """The measured pose and width of a recording nearest to `stamp_ns`, with `arm` its joints.

    Raises:
        RecordError: no pose or no gripper state was recorded.
    """
    pose, gripper = nearest(run.poses, stamp_ns), nearest(run.grippers, stamp_ns)
    if pose is None or gripper is None:
        raise RecordError(
            "the pose of the arm is unknown: no state/pose or no state/gripper was recorded"
        )
    joint = None if arm is None else nearest(run.joints, stamp_ns)
    joints_rad = None if arm is None or joint is None else arm.joints_of(joint.record)
    return ArmState(pose_of(pose.record), gripper.record.opening_m, joints_rad)


class RequestedPath(NamedTuple):
    """Waypoints that a chunk requests.

    Args:
        poses: W_0, the measured pose, to W_H.
        widths_m: openings of the gripper; None where the chunk has no gripper.
    """

    dt_s: float
    poses: list[Pose]
    widths_m: list[float] | None

    @property
    def end_s(self) -> float:
        return self.dt_s * (len(self.poses) - 1)

    def at(self, time_s: float) -> tuple[Pose, float | None]:
        """Requested pose and width `time_s` after the observation."""
        index = min(int(time_s / self.dt_s + 1e-9), len(self.poses) - 2)
        share = min(time_s / self.dt_s - index, 1.0)
        pose = interpolate(self.poses[index], self.poses[index + 1], share)
        last = round(time_s / self.dt_s + 1e-9)
        width_m = None if self.widths_m is None else self.widths_m[min(last, len(self.poses) - 1)]
        return pose, width_m


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Between workers A and B, over all pairs.

    Args:
        pairs: chunks of both whose observations are near in time.
        only_a: chunks of A without a partner.
        only_b: chunks of B without a partner.
        unreadable: pairs that cannot be compared.
        why: the reason of the last of these.
        after_s: mean time ahead at which the paths are compared.
        mean: (6,) mean of the absolute difference along `AXES`, m and rad.
        p95: (6,) its 95th percentile.
        bias: (6,) mean of B minus A.
        cosine: mean cosine between the directions, where both move; None: never.
        gripper: share of pairs in which the requested widths differ; None: not both have one.
    """

    pairs: int
    only_a: int
    only_b: int
    unreadable: int = 0
    why: str = ""
    apart_s: float = 0.0
    after_s: float = 0.0
    mean: FloatArray | None = None
    p95: FloatArray | None = None
    bias: FloatArray | None = None
    distance_m: float | None = None
    angle_rad: float | None = None
    cosine: float | None = None
    moving: int = 0
    gripper: float | None = None


def requested_path(
    spec: ActionSpec,
    steps: Steps,
    start: ArmState,
    max_width_m: float,
    arm: Kinematics | None = None,
) -> RequestedPath:
    """Waypoints of the TCP that the `steps` (H, D) of a chunk request from `start`.

    Args:
        spec: meaning of the steps.
        steps: of one arm.
        start: where the arm is.
        max_width_m: of its gripper.
        arm: places the TCP of actions in joints.

    Raises:
        RecordError: a step that does not fit the spec; actions in joints, and neither `arm` nor the
            joints of `start` are known.
    """
    if spec.space != "joint":
        poses = [start.pose, *chunk_poses(spec, steps, start.pose)]
    elif arm is None or start.joints_rad is None:
        raise RecordError("where the joints were is not in the recording (state/joint)")
    else:
        poses = _poses_of_joints(spec, steps, start.joints_rad, arm)
    widths_m = [start.width_m]
    for step in steps:
        width_m = step_width(spec, step, widths_m[-1], max_width_m)
        widths_m.append(widths_m[-1] if width_m is None else width_m)
    return RequestedPath(spec.dt_s, poses, None if spec.gripper == "none" else widths_m)


def _poses_of_joints(
    spec: ActionSpec, steps: Steps, start_rad: FloatArray, arm: Kinematics
) -> list[Pose]:
    before_rad, poses = start_rad, [arm.forward(start_rad)]
    for step in steps:
        ordered = arm.ordered(spec.joints, step[: spec.arm_size])
        before_rad = step_joints(spec, ordered, before_rad, start_rad, arm.endless)
        poses.append(arm.forward(before_rad))
    return poses


def disagreement(
    a: Sequence[ActionChunk],
    b: Sequence[ActionChunk],
    spec_a: ActionSpec,
    spec_b: ActionSpec,
    standing_at: Callable[[int], ArmState],
    *,
    max_width_m: float,
    tolerance_s: float = DEFAULT_TOLERANCE_S,
    arm: Kinematics | None = None,
) -> Disagreement:
    """Difference between workers A and B. `standing_at`: state of the arm at a wall time (ns)."""
    pairs = paired(a, b, round(tolerance_s * 1e9))
    rows: list[Difference] = []
    unreadable, why = 0, ""
    for one, other in pairs:
        start = standing_at(one.observation_stamp_ns)
        try:
            rows.append(
                difference(
                    requested_path(spec_a, one.steps, start, max_width_m, arm),
                    requested_path(spec_b, other.steps, start, max_width_m, arm),
                    max_width_m,
                )
            )
        except RecordError as error:
            unreadable, why = unreadable + 1, str(error)
    counts = (len(pairs), len(a) - len(pairs), len(b) - len(pairs), unreadable, why)
    if not rows:
        return Disagreement(*counts)
    apart_s = [abs(p.observation_stamp_ns - q.observation_stamp_ns) / 1e9 for p, q in pairs]
    differences = np.array([row.motion for row in rows])
    cosines = [row.cosine for row in rows if row.cosine is not None]
    grips = [row.gripper for row in rows if row.gripper is not None]
    return Disagreement(
        *counts,
        apart_s=float(np.mean(apart_s)),
        after_s=float(np.mean([row.after_s for row in rows])),
        mean=np.abs(differences).mean(axis=0),
        p95=np.percentile(np.abs(differences), 95, axis=0),
        bias=differences.mean(axis=0),
        distance_m=float(np.linalg.norm(differences[:, :3], axis=1).mean()),
        angle_rad=float(np.linalg.norm(differences[:, 3:], axis=1).mean()),
        cosine=float(np.mean(cosines)) if cosines else None,
        moving=len(cosines),
        gripper=float(np.mean(grips)) if grips else None,
    )


class Difference(NamedTuple):
    """Between two paths from one start, at the end of the shorter one.

    Args:
        after_s: time ahead.
        motion: (6,) along `AXES`, m and rad.
        cosine: between the directions; None: one of them does not move.
        gripper: whether the requested widths differ; None: not both have one.
    """

    after_s: float
    motion: FloatArray
    cosine: float | None
    gripper: bool | None


def difference(one: RequestedPath, other: RequestedPath, max_width_m: float) -> Difference:
    """How far the other path ends from the first one."""
    after_s = min(one.end_s, other.end_s)
    (pose_a, width_a), (pose_b, width_b) = one.at(after_s), other.at(after_s)
    motion = np.concatenate(
        [pose_b.position_m - pose_a.position_m, log3(pose_b.rotation @ pose_a.rotation.T)]
    )
    start = one.poses[0].position_m
    moved_a, moved_b = pose_a.position_m - start, pose_b.position_m - start
    length_a, length_b = float(np.linalg.norm(moved_a)), float(np.linalg.norm(moved_b))
    cosine = None
    if length_a > MOVES_M and length_b > MOVES_M:
        cosine = float(moved_a @ moved_b) / (length_a * length_b)
    gripper = None
    if width_a is not None and width_b is not None:
        gripper = abs(width_b - width_a) > GRIPPER_SHARE * max_width_m
    return Difference(after_s, motion, cosine, gripper)


def paired(
    a: Sequence[ActionChunk], b: Sequence[ActionChunk], tolerance_ns: int
) -> list[tuple[ActionChunk, ActionChunk]]:
    """Pairs nearest in time, each chunk used once, in the order of A's observations."""
    ordered = sorted(b, key=lambda chunk: chunk.observation_stamp_ns)
    stamps = [chunk.observation_stamp_ns for chunk in ordered]
    taken: set[int] = set()
    out: list[tuple[ActionChunk, ActionChunk]] = []
    for chunk in sorted(a, key=lambda chunk: chunk.observation_stamp_ns):
        stamp_ns = chunk.observation_stamp_ns
        low = bisect_left(stamps, stamp_ns - tolerance_ns)
        high = bisect_left(stamps, stamp_ns + tolerance_ns + 1)
        free = [index for index in range(low, high) if index not in taken]
        if free:
            best = min(free, key=lambda index: abs(stamps[index] - stamp_ns))
            taken.add(best)
            out.append((chunk, ordered[best]))
    return out
