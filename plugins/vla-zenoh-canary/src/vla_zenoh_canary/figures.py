"""Figures of a model in shadow beside the one that is obeyed, on one robot.

Every chunk of either is judged as the command node would judge it if its worker were obeyed. Its
age is the time from the image to its publication, both by the clock of its worker. Chunks of both
whose observations are near in time are a pair; they are compared as `vla-zenoh compare` does.

No clock, no Zenoh: `now_s` is the monotonic time of the caller.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from vla_zenoh_benchmarks.disagreement import (
    DEFAULT_TOLERANCE_S,
    ArmState,
    Difference,
    difference,
    paired,
    requested_path,
)

from vla_zenoh.control.policy_check import Lease, chunk_errors, validate_chunk
from vla_zenoh.control.preflight import CHUNK_PATIENCE_S
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.description import sliding_joints
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import pose_of
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, GripperState, JointState, PoseState, Stamped, Task

TOLERANCE_NS = round(DEFAULT_TOLERANCE_S * 1e9)
SETTLED_NS = 1_000_000_000
"""A chunk this much older than the newest of both has met its partner, if it has one."""
MAX_PENDING, MAX_STATES = 1024, 1024
Spread = tuple[float, float]
"""50th and 95th percentile."""


@dataclass(frozen=True)
class WorkerFigures:
    """One worker on one robot, over the time that was watched.

    Args:
        spec: hash of its spec; empty: none came.
        source: process that published the spec.
        restarts: further processes of its name.
        chunks: that came.
        age_ms: from the image to the chunk's publication.
        longest_silence_s: while chunks were asked for.
        silence_allowed_s: after which the command node takes a worker for absent.
        rejected: chunks that would not be executed, by the command node's name of the reason.
        failed: inferences without a chunk, by the worker's name of the reason.
    """

    worker: str
    spec: str = ""
    source: str = ""
    restarts: int = 0
    chunks: int = 0
    rate_hz: float = 0.0
    inference_ms: Spread | None = None
    age_ms: Spread | None = None
    longest_silence_s: float = 0.0
    silence_allowed_s: float = 0.0
    rejected: dict[str, int] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)

    @property
    def rejected_percent(self) -> float:
        """Of all its answers, those that no robot would have executed."""
        failed = sum(self.failed.values())
        return 100.0 * (sum(self.rejected.values()) + failed) / max(self.chunks + failed, 1)


@dataclass(frozen=True)
class Apart:
    """How far the chunks of both end from each other; of several arms the one furthest apart.

    Args:
        pairs: that were compared.
        uncompared: pairs with steps that do not fit their spec, or without a state of the arm.
        after_s: mean time ahead at which the paths are compared.
        gripper_percent: of pairs in which the widths differ; None: not both have a gripper.
    """

    pairs: int
    uncompared: int
    after_s: float = 0.0
    distance_mm: Spread | None = None
    angle_mrad: Spread | None = None
    gripper_percent: float | None = None


@dataclass(frozen=True)
class RobotFigures:
    """One robot.

    Args:
        seconds: that it was watched.
        active_s: of these the arm followed the obeyed worker.
        obeyed: the worker that was chosen all the time.
        obeyed_changed: another one was chosen meanwhile.
        new, other: the canary, and the worker that it is compared with.
    """

    robot: str
    seconds: float
    active_s: float
    obeyed: str
    obeyed_changed: bool
    new: WorkerFigures
    other: WorkerFigures
    apart: Apart


class WorkerWatch:
    """Takes what comes of one worker."""

    def __init__(self, profile: Profile, worker: str, now_s: float) -> None:
        self._profile, self.worker = profile, worker
        self.spec: ModelSpec | None = None
        self.pending: deque[ActionChunk] = deque(maxlen=MAX_PENDING)
        self._sliding = {
            part: sliding_joints(profile.of_part(part).robot) for part in profile.part_names
        }
        self._lease: Lease | None = None
        self._source, self._restarts, self._chunks = "", 0, 0
        self._inference_ms: list[float] = []
        self._age_ms: list[float] = []
        self._rejected: Counter[str] = Counter()
        self._heard_s, self._silence_s, self._allowed_s = now_s, 0.0, 0.0
        self._counted: tuple[Mapping[str, int], Mapping[str, int]] = ({}, {})

    def take_spec(self, spec: ModelSpec, source: str) -> None:
        """Take its spec; that of the first process counts until another one publishes one."""
        if source == self._source:
            return
        self._restarts += bool(self._source)
        self._source, self.spec = source, spec
        self._lease = Lease(spec, source, 0)

    def take_chunk(self, chunk: Stamped[ActionChunk], task: Task, now_s: float) -> None:
        """Judge a chunk and keep it for its partner."""
        record, lease = chunk.record, self._lease
        if lease is None:
            return
        self._heard_s = now_s
        self._chunks += 1
        published_ns = chunk.header.stamp_wall_ns
        self._inference_ms.append((record.inference_end_ns - record.inference_start_ns) / 1e6)
        self._age_ms.append((published_ns - record.observation_stamp_ns) / 1e6)
        why = self._why_rejected(chunk, lease, task)
        if why:
            self._rejected[why] += 1
        else:
            self.pending.append(record)

    def _why_rejected(self, chunk: Stamped[ActionChunk], lease: Lease, task: Task) -> str:
        # Its task may come here after the chunk that answers it.
        task = replace(task, episode=chunk.record.episode)
        oldest_s = self._profile.timing.max_observation_age_s
        found = validate_chunk(
            chunk, lease.source, lease, task, oldest_s, chunk.header.stamp_wall_ns
        )
        if found is not None:
            return found.reason
        for part in lease.spec.parts:
            own, action = self._profile.of_part(part), lease.spec.action
            steps = chunk.record.steps[:, action.columns(part)]
            width_m = own.robot.max_width_m
            sliding = self._sliding.get(part, frozenset())
            for error in chunk_errors(action.of(part), steps, own.limits, width_m, sliding):
                return error.name
        return ""

    def take_counters(self, counters: Mapping[str, int]) -> None:
        """Take the counters of its status."""
        first = self._counted[0] or counters
        self._counted = (first, counters)

    def tick(self, asked_hz: float, now_s: float) -> None:
        """How long it is silent; `asked_hz`: chunks that it is asked for now."""
        if asked_hz <= 0.0:
            self._heard_s = now_s
            return
        self._allowed_s = max(self._allowed_s, CHUNK_PATIENCE_S + 1.0 / asked_hz)
        self._silence_s = max(self._silence_s, now_s - self._heard_s)

    def figures(self, seconds: float) -> WorkerFigures:
        """What is known by now, after so many seconds."""
        first, last = self._counted
        prefix = "refused."
        grown = {
            name.removeprefix(prefix): count - first.get(name, 0)
            for name, count in last.items()
            if name.startswith(prefix) and count > first.get(name, 0)
        }
        return WorkerFigures(
            self.worker,
            "" if self.spec is None else self.spec.hash,
            self._source,
            self._restarts,
            self._chunks,
            round(self._chunks / seconds, 3) if seconds > 0 else 0.0,
            spread(self._inference_ms),
            spread(self._age_ms),
            round(self._silence_s, 3),
            round(self._allowed_s, 3),
            dict(sorted(self._rejected.items())),
            dict(sorted(grown.items())),
        )


class RobotWatch:
    """Takes what comes of both workers of one robot, and where its arms are.

    Args:
        profile: of this robot.
        new: the canary.
        other: the worker that it is compared with.
        arm_of: kinematics of a part; asked for actions in joints alone.
        now_s: when it begins.
    """

    def __init__(
        self,
        profile: Profile,
        new: str,
        other: str,
        arm_of: Callable[[str], Kinematics],
        now_s: float,
    ) -> None:
        self._profile, self._arm_of = profile, arm_of
        self.workers = {name: WorkerWatch(profile, name, now_s) for name in (new, other)}
        self._new, self._other = self.workers[new], self.workers[other]
        self._began_s = self._ticked_s = now_s
        self._active_s, self._obeyed, self._changed = 0.0, "", False
        self._states = {name: deque[_State](maxlen=MAX_STATES) for name in profile.part_names}
        self._uncompared = 0
        self._distance_mm: list[float] = []
        self._angle_mrad: list[float] = []
        self._after_s: list[float] = []
        self._grips: list[bool] = []

    def take_state(
        self,
        part: str,
        pose: Stamped[PoseState],
        joint: JointState | None,
        gripper: GripperState | None,
    ) -> None:
        """Where an arm is."""
        state = _State(pose.header.stamp_wall_ns, pose.record, joint, gripper)
        self._states[part].append(state)

    def tick(self, task: Task | None, now_s: float) -> None:
        """Time has passed; compare the pairs that are complete."""
        if task is None:
            return
        self._changed |= self._obeyed not in ("", task.worker)
        self._obeyed = self._obeyed or task.worker
        self._active_s += (now_s - self._ticked_s) * task.active
        self._ticked_s = now_s
        for worker in self.workers.values():
            worker.tick(task.requested_hz, now_s)
        self._compare(SETTLED_NS)

    def figures(self, now_s: float) -> RobotFigures:
        """What is known by now."""
        self._compare(0)
        seconds = now_s - self._began_s
        grips = self._grips
        apart = Apart(
            len(self._distance_mm),
            self._uncompared,
            round(float(np.mean(self._after_s)), 3) if self._after_s else 0.0,
            spread(self._distance_mm),
            spread(self._angle_mrad),
            round(100.0 * sum(grips) / len(grips), 1) if grips else None,
        )
        return RobotFigures(
            self._profile.robot.name,
            round(seconds, 3),
            round(self._active_s, 3),
            self._obeyed,
            self._changed,
            self._new.figures(seconds),
            self._other.figures(seconds),
            apart,
        )

    def _compare(self, settled_ns: int) -> None:
        new, other = self._new.pending, self._other.pending
        if not new or not other:
            return
        newest_ns = min(each[-1].observation_stamp_ns for each in (new, other))
        until_ns = newest_ns - settled_ns
        if new[0].observation_stamp_ns > until_ns:
            return
        done: set[int] = set()
        for pair in paired(other, new, TOLERANCE_NS):
            if max(chunk.observation_stamp_ns for chunk in pair) <= until_ns:
                done |= set(map(id, pair))
                self._take_pair(*pair)
        oldest_ns = until_ns - TOLERANCE_NS
        for each in (new, other):
            left = [chunk for chunk in each if chunk.observation_stamp_ns > oldest_ns]
            left = [chunk for chunk in left if id(chunk) not in done]
            each.clear()
            each.extend(left)

    def _take_pair(self, before: ActionChunk, after: ActionChunk) -> None:
        one, other = self._other.spec, self._new.spec
        assert one is not None and other is not None  # a chunk without a spec is not kept
        try:
            found = [self._difference(part, one, before, other, after) for part in self._states]
        except RecordError:
            self._uncompared += 1
            return
        self._distance_mm.append(max(1e3 * float(np.linalg.norm(d.motion[:3])) for d in found))
        self._angle_mrad.append(max(1e3 * float(np.linalg.norm(d.motion[3:])) for d in found))
        self._after_s.append(found[0].after_s)
        grips = [each.gripper for each in found if each.gripper is not None]
        self._grips += [any(grips)] if grips else []

    def _difference(
        self, part: str, one: ModelSpec, before: ActionChunk, other: ModelSpec, after: ActionChunk
    ) -> Difference:
        width_m = self._profile.of_part(part).robot.max_width_m
        joint = "joint" in (one.action.of(part).space, other.action.of(part).space)
        arm = self._arm_of(part) if joint else None
        start = self._start(part, before.observation_stamp_ns, arm)
        wanted, other_wanted = (
            requested_path(
                spec.action.of(part), chunk.steps[:, spec.action.columns(part)], start, width_m, arm
            )
            for spec, chunk in ((one, before), (other, after))
        )
        return difference(wanted, other_wanted, width_m)

    def _start(self, part: str, stamp_ns: int, arm: Kinematics | None) -> ArmState:
        if not self._states[part]:
            raise RecordError("no pose of the arm came")
        state = min(self._states[part], key=lambda each: abs(each.stamp_ns - stamp_ns))
        width_m = 0.0 if state.gripper is None else state.gripper.opening_m
        joints_rad = None
        if arm is not None and state.joint is not None:
            joints_rad = arm.joints_of(state.joint)
        return ArmState(pose_of(state.pose), width_m, joints_rad)


@dataclass(frozen=True, slots=True)
class _State:
    stamp_ns: int
    pose: PoseState
    joint: JointState | None
    gripper: GripperState | None


def spread(values: list[float]) -> Spread | None:
    """p50 and p95 of `values`; None: there are none."""
    if not values:
        return None
    p50, p95 = np.percentile(values, (50, 95)).tolist()
    return round(p50, 2), round(p95, 2)
