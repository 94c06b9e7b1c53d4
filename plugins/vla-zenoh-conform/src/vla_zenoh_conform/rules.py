"""The rules of the wire, each a function from what was recorded to findings. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.cli.status_table import complaints
from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, pose_distance, rotation_from_quat
from vla_zenoh.policy import ModelSpec, check_steps
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import (
    ActionChunk,
    ClockReply,
    Depth,
    JointBound,
    JointState,
    PoseState,
    Task,
)
from vla_zenoh_conform.samples import Arrived, of_key

LEAST_STATE_HZ = 20.0
MOST_AGE_S, MOST_AHEAD_S = 1.0, 0.1
"""Of a stamp, on our clock."""
RATE_SHARE = 0.7
"""Of the rate that was asked for."""
APART_M, APART_RAD = 0.01, 0.05
"""Of the reported pose from that of the joints, as in the command node."""
RANGE = JointBound(0.1, 0.03)
WIDTH_M = 0.01
FOLLOWED, IGNORED = 0.8, 0.3
"""Shares of the way that commands asked for: a good stream is followed at least so far, a wrong one
at most."""
STOPPED_S = 1.0
"""From a stop, or the end of the robot's patience with silence, until the arm stands."""
STOPPED_SHARE = 0.25
"""Of the way, while the arm brakes from the speed it has in the middle of it."""
REPEATED_SHARE = 0.2
"""Of a camera's images may be as the one before: every sensor has noise."""
ROBOT_KEYS = ("state/joint", "state/pose", "state/gripper")


class RuleFinding(NamedTuple):
    """What one rule found; `right` is None where there was nothing to judge."""

    rule: str
    right: bool | None
    text: str


@dataclass(frozen=True, slots=True)
class Seen:
    """What was recorded of a peer.

    Args:
        node: its name.
        samples: in the order of their arrival.
        seconds: how long was listened.
        clocks: its replies, with the times of asking and arrival, wall clock, ns.
        replied: spec that a worker answered on a query.
    """

    node: str
    samples: Sequence[Arrived]
    seconds: float
    alive: bool = True
    clocks: Sequence[tuple[int, ClockReply, int]] = ()
    replied: ModelSpec | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """How the arm moved while it was sent commands.

    Args:
        what: one of `TRIALS`.
        asked: way that the commands lead, rad of a joint or m.
        track: (time in s, way, mode) of every state, from the first command on.
        event_s: when the stop was put, or the stream ended.
        patience_s: for so long the robot may go on then.
    """

    what: str
    asked: float
    track: Sequence[tuple[float, float, str]] = ()
    event_s: float = 0.0
    patience_s: float = 0.0


# -- every stream -----------------------------------------------------------------------------
def presence(seen: Seen) -> Iterator[RuleFinding]:
    """Liveliness token and clock."""
    name = f"alive/{seen.node}"
    yield RuleFinding("alive", seen.alive, name if seen.alive else f"there is no token {name}")
    if not seen.clocks:
        yield RuleFinding("clock", False, f"no valid reply on clock/{seen.node}")
        return
    asked_ns, reply, got_ns = min(seen.clocks, key=lambda each: each[2] - each[0])
    offset_s = ((reply.heard_ns - asked_ns) + (reply.said_ns - got_ns)) / 2e9
    if reply.said_ns < reply.heard_ns:
        yield RuleFinding("clock", False, "said_ns is before heard_ns")
    else:
        yield RuleFinding("clock", True, f"{1e3 * offset_s:+.1f} ms from this one")


def stream(seen: Seen, key: str, least_hz: float) -> Iterator[RuleFinding]:
    """Records, writer, order, stamps and rate of one key."""
    samples = of_key(seen.samples, key)
    if not samples:
        text = "; ".join([f"nothing in {seen.seconds:.0f} s", *_own_words(seen)])
        yield RuleFinding(f"{key}: rate", False, text)
        return
    bad = [sample.why for sample in samples if sample.why]
    text = f"{len(bad)} of {len(samples)}: {bad[0]}" if bad else f"{len(samples)} valid"
    yield RuleFinding(f"{key}: records", not bad, text)
    unknown = sorted({name for sample in samples for name in sample.unknown})
    if unknown:
        yield RuleFinding(f"{key}: fields", False, f"not of this version: {', '.join(unknown[:8])}")
    good = [sample for sample in samples if sample.header is not None]
    if good:
        yield from _headers(seen, key, good)
    hz = len(samples) / seen.seconds
    text = f"{hz:.1f} Hz, at least {least_hz:g} are wanted"
    yield RuleFinding(f"{key}: rate", hz >= least_hz, text)


def _own_words(seen: Seen) -> Iterator[str]:
    """What the node itself says is wrong, by its newest status."""
    said = [each.record for each in of_key(seen.samples, f"status/{seen.node}") if each.record]
    for why in complaints(said[-1].detail) if said else ():
        yield f"its status says: {why}"


def _headers(seen: Seen, key: str, samples: Sequence[Arrived]) -> Iterator[RuleFinding]:
    headers: list[Any] = [sample.header for sample in samples]
    sources = sorted({header.source for header in headers})
    named = all(source.startswith(f"{seen.node}#") for source in sources)
    right = len(sources) == 1 and named
    wanted = f"{', '.join(sources[:4])}; wanted: one, {seen.node}#..."
    yield RuleFinding(f"{key}: source", right, sources[0] if right else wanted)
    steps = [after.seq - before.seq for before, after in pairwise(headers)]
    wrong = sum(step <= 0 for step in steps)
    lost = sum(step - 1 for step in steps if step > 1)
    text = f"{wrong} do not grow" if wrong else f"grows, {lost} missing"
    yield RuleFinding(f"{key}: seq", not wrong, text)
    back = sum(b.stamp_wall_ns <= a.stamp_wall_ns for a, b in pairwise(headers))
    ages_s = [
        (each.received_ns - h.stamp_wall_ns) / 1e9 for each, h in zip(samples, headers, strict=True)
    ]
    old_s, young_s = max(ages_s), min(ages_s)
    if back:
        yield RuleFinding(f"{key}: stamps", False, f"{back} do not grow")
    elif old_s > MOST_AGE_S or young_s < -MOST_AHEAD_S:
        text = f"{young_s:.3f} to {old_s:.3f} s old: nanoseconds of another clock, or of no clock?"
        yield RuleFinding(f"{key}: stamps", False, text)
    else:
        yield RuleFinding(f"{key}: stamps", True, f"{young_s:.3f} to {old_s:.3f} s old")


# -- robot ------------------------------------------------------------------------------------
def robot(seen: Seen, profile: Profile, kinematics: Kinematics) -> Iterator[RuleFinding]:
    """All rules of a robot that is only looked at."""
    yield from presence(seen)
    for key in ROBOT_KEYS:
        yield from stream(seen, key, LEAST_STATE_HZ)
    by_key = {key: _by_stamp(of_key(seen.samples, key)) for key in ROBOT_KEYS}
    pairs = [set(found) for found in by_key.values()]
    together = set.intersection(*pairs)
    share = len(together) / max(map(len, pairs)) if any(pairs) else 0.0
    text = f"{100 * share:.0f} % have stamp and seq of all three"
    yield RuleFinding("states belong together", share > RATE_SHARE, text)
    joints, poses, grippers = by_key.values()
    yield from _joints(list(joints.values()), profile, kinematics)
    yield from _poses([(joints[at], poses[at]) for at in sorted(together)], profile, kinematics)
    known = [gripper.width_m for gripper in grippers.values()]
    widths_m = [width_m for width_m in known if width_m is not None]
    if known and (profile.robot.gripper is None) != (not widths_m):
        text = profile.robot.no_gripper or "the profile's gripper has no width_m"
        yield RuleFinding("gripper as declared", False, text)
    elif widths_m:
        most_m = profile.robot.max_width_m
        text = f"up to {max(widths_m):.4g} m; the profile's gripper opens {most_m:g} m"
        yield RuleFinding("gripper width in m", max(widths_m) <= most_m + WIDTH_M, text)


def _by_stamp(samples: Sequence[Arrived]) -> dict[tuple[int, int], Any]:
    return {
        (each.header.stamp_wall_ns, each.header.seq): each.record
        for each in samples
        if each.header is not None and each.record is not None
    }


def _joints(
    joints: Sequence[JointState], profile: Profile, kinematics: Kinematics
) -> Iterator[RuleFinding]:
    wanted = sorted(profile.robot.arm_joints)
    if not joints:
        yield RuleFinding("joint names", None, "no joints to judge")
        return
    names = {name for state in joints for name in state.names}
    right = sorted(names) == wanted
    text = f"{len(names)} of the profile" if right else f"{sorted(names)}, wanted: {wanted}"
    yield RuleFinding("joint names", right, text)
    if not right:
        return
    measured = np.array([kinematics.joints_of(state) for state in joints])
    beyond = RANGE.of(kinematics.slides)
    low, high = kinematics.lower_rad - beyond, kinematics.upper_rad + beyond
    outside = np.any((measured < low) | (measured > high), axis=0).tolist()
    where = ", ".join(name for name, out in zip(kinematics.arm_joints, outside, strict=True) if out)
    text = f"out of range: {where}; degrees, or another zero?" if where else "within their ranges"
    yield RuleFinding("joints in rad", not where, text)


def _poses(
    pairs: Sequence[tuple[JointState, PoseState]], profile: Profile, kinematics: Kinematics
) -> Iterator[RuleFinding]:
    wanted = sorted(profile.robot.arm_joints)
    apart = [
        _apart(kinematics, joint, pose) for joint, pose in pairs if sorted(joint.names) == wanted
    ]
    if not apart:
        yield RuleFinding("pose is that of the joints", None, "no pose with joints to judge")
        return
    apart_m, apart_rad = np.max(apart, axis=0)
    right = apart_m <= APART_M and apart_rad <= APART_RAD
    text = f"{1e3 * apart_m:.1f} mm and {apart_rad:.3f} rad apart at most"
    hint = "" if right else "; another unit, base or TCP?"
    yield RuleFinding("pose is that of the joints", bool(right), text + hint)


def _apart(kinematics: Kinematics, joint: JointState, pose: PoseState) -> tuple[float, float]:
    measured = Pose(pose.position_m, rotation_from_quat(pose.quat_xyzw))
    return pose_distance(kinematics.forward(kinematics.joints_of(joint)), measured)


# -- robot that is moved ------------------------------------------------------------------------
FOLLOW, SILENT, STOP = "follows commands", "brakes when they fall silent", "brakes on a stop"
LATCHED, AFTER_RESET = "obeys nothing until reset", "follows commands after a reset"
NAN, REPLAYED = "rejects NaN", "rejects a seq that does not grow"
FOREIGN, STALE = "rejects a second writer", "rejects commands that are 2 s old"
DURATION_S, PEAK = 2.0, 1.875
"""Of the motion that commands ask for, and its greatest speed in ways per duration."""
WRONG = (NAN, REPLAYED, FOREIGN, STALE)
TRIALS = (FOLLOW, NAN, REPLAYED, FOREIGN, STALE, SILENT, STOP, LATCHED, AFTER_RESET)


def way_at(time_s: float) -> float:
    """Share of the way at a time of the motion: minimum jerk, from rest to rest."""
    s = min(max(time_s / DURATION_S, 0.0), 1.0)
    return s**3 * (10 - 15 * s + 6 * s * s)


def moved(trials: Sequence[Trial]) -> Iterator[RuleFinding]:
    """The rules of a robot that was sent commands."""
    for trial in trials:
        if not trial.track:
            yield RuleFinding(trial.what, False, "no valid states while it was commanded")
            continue
        yield _moved(trial)


def _moved(trial: Trial) -> RuleFinding:
    way = max((abs(way) for _, way, _ in trial.track), default=0.0)
    share = way / trial.asked
    text = f"{100 * share:.0f} % of the way"
    if trial.what in (FOLLOW, AFTER_RESET):
        return RuleFinding(trial.what, share >= FOLLOWED, text)
    if trial.what in (*WRONG, LATCHED):
        return RuleFinding(trial.what, share <= IGNORED, text)
    stands_s = _stands_s(trial)
    until = min(trial.event_s, DURATION_S)
    most = way_at(until) + PEAK * trial.patience_s / DURATION_S + STOPPED_SHARE
    right = share <= most and stands_s <= trial.patience_s + STOPPED_S
    text = f"{text}, stands after {stands_s:.2f} s"
    mode = trial.track[-1][2]
    if trial.what == STOP and mode == "ready":
        return RuleFinding(trial.what, False, f"{text}; its mode is still 'ready'")
    return RuleFinding(trial.what, right, text)


STILL_SHARE = 0.01


def _stands_s(trial: Trial) -> float:
    """From the event until the arm is, and stays, where it ends."""
    end = trial.track[-1][1]
    moving = [at_s for at_s, way, _ in trial.track if abs(way - end) > STILL_SHARE * trial.asked]
    return max(0.0, moving[-1] - trial.event_s) if moving else 0.0


# -- worker -----------------------------------------------------------------------------------
def worker(seen: Seen, profile: Profile) -> Iterator[RuleFinding]:
    """All rules of a worker, whose node is ``worker-NAME``."""
    name = seen.node.removeprefix("worker-")
    yield from presence(seen)
    yield from stream(seen, f"spec/{name}", RATE_SHARE)
    specs = [each.record for each in of_key(seen.samples, f"spec/{name}") if each.record]
    tasks = [each.record for each in of_key(seen.samples, "task") if each.record]
    spec: ModelSpec | None = specs[-1] if specs else None
    same = spec is not None and seen.replied == spec
    yield RuleFinding("spec on query", same, "as published" if same else "not what it publishes")
    if not tasks:
        yield RuleFinding("chunks", None, "no command node publishes a task")
        return
    # A slower arm asks its worker less often; one that goes on at the task's rate is right, too.
    least_hz = min(task.requested_hz for task in tasks)
    if least_hz == 0.0:
        yield RuleFinding("chunks", None, "the speed override is 0: none were asked for")
    else:
        yield from stream(seen, f"delta/{name}", RATE_SHARE * least_hz)
    chunks = [each for each in of_key(seen.samples, f"delta/{name}") if each.record]
    if spec is not None and chunks:
        yield from _chunks(name, chunks, spec, tasks, profile)


def _chunks(
    name: str, chunks: Sequence[Arrived], spec: ModelSpec, tasks: Sequence[Task], profile: Profile
) -> Iterator[RuleFinding]:
    found: list[ActionChunk] = [each.record for each in chunks]
    named = all(chunk.worker == name for chunk in found)
    yield RuleFinding("worker in chunks", named, name if named else found[0].worker)
    hashes = {chunk.spec_hash for chunk in found}
    text = spec.hash if hashes == {spec.hash} else f"{hashes}, that of its spec is {spec.hash}"
    yield RuleFinding("spec_hash", hashes == {spec.hash}, text)
    episodes = {task.episode for task in tasks}
    wrong = {chunk.episode for chunk in found} - episodes
    yield RuleFinding(
        "episode", not wrong, f"{sorted(wrong)} was not asked for" if wrong else "asked"
    )
    late = sum(not _in_order(each) for each in chunks)
    text = f"{late} not: observation, observed, start, end, published, valid until"
    yield RuleFinding("times in order", not late, text if late else "in order")
    yield _steps(found, spec, profile)


def _in_order(chunk: Arrived) -> bool:
    record, header = chunk.record, chunk.header
    assert header is not None
    times = (
        *(record.observation_stamp_ns, record.observed_ns, record.inference_start_ns),
        *(record.inference_end_ns, header.stamp_wall_ns, record.valid_until_ns),
    )
    return all(before <= after for before, after in pairwise(times))


def _steps(chunks: Sequence[ActionChunk], spec: ModelSpec, profile: Profile) -> RuleFinding:
    action, rule = spec.action, "steps as its spec says"
    try:
        for chunk in chunks:
            check_steps(action, chunk.steps)
    except SpecError as error:
        return RuleFinding(rule, False, str(error))
    if action.space == "tcp" and not action.parts:
        most_m = np.abs(np.concatenate([chunk.steps[:, :3] for chunk in chunks])).max()
        most_m *= action.position_scale_m
        limit_m = 10.0 if action.targets else 4 * profile.limits.step_m
        if most_m > limit_m:
            return RuleFinding(rule, False, f"x, y, z up to {most_m:g} m: another unit?")
    return RuleFinding(rule, True, f"{len(chunks)} chunks")


# -- camera -----------------------------------------------------------------------------------
def camera_keys(name: str, wanted: CameraProfile) -> list[str]:
    """The keys of a camera, below the robot."""
    kinds = ["raw", "jpeg"] if wanted.depth_unit_m is None else ["raw", "jpeg", "depth"]
    return [f"camera/{name}/{kind}" for kind in kinds]


def camera(seen: Seen, name: str, profile: Profile) -> Iterator[RuleFinding]:
    """All rules of a camera's node."""
    yield from presence(seen)
    yield _age(seen, name)
    wanted = profile.cameras[name]
    width, height = wanted.width, wanted.height
    raw, jpeg, *depth = camera_keys(name, wanted)
    yield from _images(seen, raw, wanted.rate_hz, (height, width))
    scale = min(1.0, (wanted.jpeg_width or width) / width)
    size = round(height * scale), round(width * scale)
    rate_hz = min(wanted.rate_hz, wanted.jpeg_rate_hz or wanted.rate_hz)
    yield from _images(seen, jpeg, rate_hz, size)
    for key in depth:
        yield from _images(seen, key, wanted.rate_hz, (height, width))
        units_m = {image.unit_m for image in _records(seen, key)}
        if units_m:
            shown_m = ", ".join(f"{unit_m:g}" for unit_m in sorted(units_m))
            text = f"{shown_m} m a count, of the profile {wanted.depth_unit_m:g}"
            yield RuleFinding(f"{key}: unit", units_m == {wanted.depth_unit_m}, text)


def _age(seen: Seen, name: str) -> RuleFinding:
    """Whether the status says how old the newest image is, or why there is none: without it nothing
    that needs the camera is activated."""
    told = [status.detail.get("cameras") for status in _records(seen, f"status/{seen.node}")]
    fields = [cameras.get(name) if isinstance(cameras, Mapping) else None for cameras in told]
    right = [isinstance(each, Mapping) and _says_age(each) for each in fields]
    text = f"detail.cameras.{name}.age_s in {sum(right)} of {len(told)} statuses"
    return RuleFinding("status: age of its images", bool(told) and all(right), text)


def _says_age(fields: Mapping[str, Any]) -> bool:
    age_s = fields.get("age_s")
    return isinstance(age_s, int | float) or (age_s is None and bool(fields.get("why")))


def _images(seen: Seen, key: str, rate_hz: float, wanted: tuple[int, int]) -> Iterator[RuleFinding]:
    yield from stream(seen, key, RATE_SHARE * rate_hz)
    pixels = [
        image.counts if isinstance(image, Depth) else image.rgb for image in _records(seen, key)
    ]
    if not pixels:
        return
    sizes = {each.shape[:2] for each in pixels}
    shown = ", ".join(f"{width}x{height}" for height, width in sorted(sizes))
    text = f"{shown}, of the profile {wanted[1]}x{wanted[0]}"
    yield RuleFinding(f"{key}: size", sizes == {wanted}, text)
    if len(pixels) == 1:
        return
    same = sum(np.array_equal(before, after) for before, after in pairwise(pixels))
    text = f"{same} of {len(pixels)} repeat the one before"
    hint = "" if same == 0 else "; a simulator's do where nothing moves"
    right = same <= REPEATED_SHARE * len(pixels)
    yield RuleFinding(f"{key}: images change", right, text + hint)


def _records(seen: Seen, key: str) -> list[Any]:
    return [each.record for each in of_key(seen.samples, key) if each.record is not None]
