"""Evaluates a recording: requested, commanded and measured motion, and latencies by stage."""

from __future__ import annotations

import datetime as dt
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.errors import MissingExtraError, ProfileError
from vla_zenoh.lab.evaluation.filmstrip import filmstrip
from vla_zenoh.lab.evaluation.result import TASKS, Evaluation, PlotTrace, TaskVerdict
from vla_zenoh.lab.evaluation.segments import (
    angles_rad,
    idle_s,
    path_m,
    rotvecs,
    segment,
    turned_rad,
)
from vla_zenoh.lab.recording.film import Film, write_film
from vla_zenoh.lab.recording.run import RecordedSample, Run
from vla_zenoh.lab.recording.verdict import FACT
from vla_zenoh.policy.options import shown
from vla_zenoh.profile import Profile, read_profile
from vla_zenoh.types import LATENCY_STAGES, Cause, FloatArray, JointCommand, NodeStatus, PoseCommand


def provenance(run: Run) -> dict[str, str]:
    """Name and value of each known fact."""
    about, ended = run.file.about, run.file.ended or {}
    began = dt.datetime.fromtimestamp(run.began_ns / 1e9).astimezone()
    rates = dict.fromkeys(f"{entry.record.rate_hz:g}" for entry in run.tasks if entry.record.active)
    facts = {
        "recorded": f"{began:%Y-%m-%d %H:%M:%S %Z}, {run.seconds:.0f} s",
        "host": about.get("host", ""),
        "code": about.get("code") or about.get("version", ""),
        "command": about.get("command", ""),
        "robot": about["robot"],
        "profile": about.get("profile", ""),
        "model": _models(run),
        "rate": f"{', '.join(rates)} Hz" if rates else "",
        "seed": str(ended.get("seed", "")),
    }
    return {name: value for name, value in facts.items() if value}


def _models(run: Run) -> str:
    """Workers that the arm obeyed, with model and options."""
    try:
        profile = read_profile(run.file.profile_yaml, str(run.path))
    except ProfileError:
        profile = None
    workers = dict.fromkeys(worker for _, _, worker in run.activations())
    return "; ".join(_model(worker, profile) for worker in workers)


def _model(worker: str, profile: Profile | None) -> str:
    if profile is None:
        return worker
    model = profile.models.get(worker, worker)
    options = shown(profile.options.get(worker, {}))
    words = [model] if model != worker else []
    words += [f"{name}={value}" for name, value in options.items()]
    return f"{worker} ({', '.join(words)})" if words else worker


def verdicts(run: Run) -> list[TaskVerdict]:
    """Verdicts in the recording: of a demo's judge, or of the person of a trial."""
    ended = run.file.ended or {}
    out: list[TaskVerdict] = []
    tasks = ended.get(TASKS)
    for fact in tasks if isinstance(tasks, list) else ():
        if isinstance(fact, dict):
            said, success = str(fact.get("said", "")), fact.get("success")
            out.append(
                TaskVerdict(
                    str(fact.get("prompt", "")), success if type(success) is bool else None, said
                )
            )
    trial = ended.get(FACT)
    if isinstance(trial, dict) and "verdict" in trial:
        word, note = str(trial["verdict"]), str(trial.get("note", ""))
        prompt = str(trial.get("prompt", ""))
        success = None if word == "void" else word == "success"
        out.append(TaskVerdict(prompt, success, f"{word}: {note}" if note else word))
    return out


FILM, MAX_FILM_S = Film(height_px=270, rate_hz=10, quality=30), 180.0
"""The film of a page, and how long a run may be for one."""
SHOWN_LOST, SHOWN_LIMITS = 5, 3
GAP_S = 0.05
"""A longer gap in a stream is an interruption; nothing is derived across it."""
PERIOD_QUANTILE = 0.05
"""Of the gaps between commands: the period of the stream in motion."""


class MeasuredMotion(NamedTuple):
    """A stream of poses: stamps (n,) in s since the start of the run, (n, 3), (n, 4), (n, 6)."""

    t_s: FloatArray
    position_m: FloatArray
    quat_xyzw: FloatArray
    twist: FloatArray

    def part(self, since_s: float, until_s: float) -> MeasuredMotion:
        """The samples stamped within an interval."""
        first, last = np.searchsorted(self.t_s, (since_s, until_s))
        return MeasuredMotion(*(column[first:last] for column in self))


def evaluate_parts(run: Run, *, pictures: int = 0) -> list[Evaluation]:
    """One evaluation of each part, named ``RUN/PART``; of one arm just that.

    Requests, latencies and rejections are those of the robot, the same for all parts; pictures and
    film are in the first.
    """
    first, *others = run.part_names
    own = [evaluate_loaded(run.of_part(first), pictures=pictures)]
    return own + [evaluate_loaded(run.of_part(part)) for part in others]


def evaluate_loaded(run: Run, *, pictures: int = 0) -> Evaluation:
    """Evaluate a run of one arm or part; `Evaluation.problems` lists what cannot be read."""
    zero_ns = run.began_ns
    own = run.path.stem
    name = (run.path.resolve().parent.name if own == "run" else "") or own
    name += f"/{run.part}" if run.part else ""
    out = Evaluation(name, run.path, problems=list(run.problems))
    if run.file.ended is None and not run.file.damage:
        out.problems.append("its recorder was ended before it could finish the file")
    if run.file.dropped:
        out.problems.append(f"the recorder dropped {run.file.dropped} samples")
    lost = (run.file.ended or {}).get("lost")
    if isinstance(lost, dict) and lost:
        worst = ", ".join(f"{key} {count}" for key, count in list(lost.items())[:SHOWN_LOST])
        out.problems.append(f"samples never reached the recorder: {worst}")
    obeyed = run.obeyed_chunks()
    causes = run.first_commands()
    _requests(out, obeyed, causes, zero_ns)
    measured, commanded = _stream(run.poses, zero_ns), _commanded(run, zero_ns)
    _motion(out, measured, commanded)
    out.width_m = np.array([entry.record.opening_m for entry in run.grippers])
    out.width_t_s = np.array([(e.header.stamp_wall_ns - zero_ns) / 1e9 for e in run.grippers])
    _seams(out, run.commands)
    _jerk(out, run)
    _idle(out, run, measured)
    out.refusals = _counted(run.first_statuses, run.statuses, "refused.")
    out.skipped = _counted(run.first_statuses, run.statuses, "skipped.")
    out.gripper_orders = len(run.gripper_commands)
    _segments(out, run, causes, measured)
    if causes and causes[0][0].received_ns < run.began_ns:
        out.problems.append(
            "the recording began after the arm had begun to move: the motion before is not in it, "
            "and how much of what was asked for was done before is not known"
        )
        for first in out.segments[:1]:
            out.segments[0] = replace(first, asked_m=None, asked_rad=None)
    out.problems += [found.shortfall for found in out.segments if found.shortfall]
    out.about, out.verdicts = provenance(run), verdicts(run)
    if pictures:
        out.views = filmstrip(run, [entry.record for entry in obeyed], pictures)
        out.film = _film(run)
    return out


def _film(run: Run) -> bytes:
    """The cameras as MP4; empty where there is none, it would be too long, or PyAV is missing."""
    if not 0 < run.seconds <= MAX_FILM_S:
        return b""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mp4"
        try:
            return path.read_bytes() if write_film(path, run, FILM) else b""
        except MissingExtraError:
            return b""


# -- requests -------------------------------------------------------------------------------------
def _requests(
    out: Evaluation,
    obeyed: Sequence[RecordedSample],
    causes: Sequence[tuple[Cause, int]],
    zero_ns: int,
) -> None:
    out.requests = len(obeyed)
    carried_out = {(cause.worker, cause.chunk_seq) for cause, _ in causes}
    out.executed = sum((entry.record.worker, entry.header.seq) in carried_out for entry in obeyed)
    if obeyed:
        first, last = obeyed[0].header, obeyed[-1].header
        out.seconds = (last.stamp_wall_ns - first.stamp_wall_ns) / 1e9
    rows = [cause.latency_ms(stamp_ns) for cause, stamp_ns in causes]
    out.stages_ms = {name: np.array([row[name] for row in rows]) for name in LATENCY_STAGES}
    out.stages_ms["outbound"] = out.stages_ms.pop("capture_to_worker")
    out.stages_ms["inbound"] = out.stages_ms["worker_to_command"] + out.stages_ms["command_to_pose"]
    out.request_t_s = np.array([(stamp - zero_ns) / 1e9 for _, stamp in causes])


# -- motion ---------------------------------------------------------------------------------------
def _stream(entries: Iterable[RecordedSample], zero_ns: int, prefix: str = "") -> MeasuredMotion:
    """Poses of records, or with ``reference_`` those of the controller's reference."""
    rows = [
        (
            (entry.header.stamp_wall_ns - zero_ns) / 1e9,
            getattr(entry.record, f"{prefix}position_m"),
            getattr(entry.record, f"{prefix}quat_xyzw"),
            entry.record.twist,
        )
        for entry in entries
    ]
    if not rows:
        return MeasuredMotion(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 6)))
    t_s, position, quat, twist = (np.array(column) for column in zip(*rows, strict=True))
    order = np.argsort(t_s, kind="stable")
    return MeasuredMotion(t_s[order], position[order], quat[order], twist[order])


def _commanded(run: Run, zero_ns: int) -> MeasuredMotion:
    """Pose commands; for joint commands the reference pose of the controller."""
    if run.commands:
        return _stream(run.commands, zero_ns)
    told = [entry for entry in run.poses if entry.record.reference_position_m is not None]
    return _stream(told, zero_ns, "reference_")


def _motion(out: Evaluation, measured: MeasuredMotion, commanded: MeasuredMotion) -> None:
    out.path_m = path_m(measured.position_m)
    out.path_rad = turned_rad(measured.quat_xyzw)
    out.command_path_m = path_m(commanded.position_m)
    out.command_path_rad = turned_rad(commanded.quat_xyzw)
    start = measured if len(measured.t_s) else commanded
    for name, motion in (("measured", measured), ("commanded", commanded)):
        if len(motion.t_s):
            quats = np.vstack([start.quat_xyzw[:1], motion.quat_xyzw])
            speed_m_s = np.linalg.norm(motion.twist[:, :3], axis=1)
            turns = rotvecs(quats)[1:]
            setattr(out, name, PlotTrace(motion.t_s, motion.position_m, turns, speed_m_s))
    if not (len(measured.t_s) and len(commanded.t_s) > 1):
        return
    times_s, now_s = commanded.t_s, measured.t_s
    later = np.clip(np.searchsorted(times_s, now_s), 1, len(times_s) - 1)
    before_s, after_s = times_s[later - 1], times_s[later]
    within = (now_s >= before_s) & (now_s <= after_s) & (after_s - before_s < GAP_S)
    between = [np.interp(now_s, times_s, axis) for axis in commanded.position_m.T]
    off = np.linalg.norm(np.column_stack(between) - measured.position_m, axis=1)
    nearer = np.where(now_s - before_s < after_s - now_s, later - 1, later)
    turned = angles_rad(commanded.quat_xyzw[nearer], measured.quat_xyzw)
    out.tracking_mm, out.tracking_mrad = off[within] * 1e3, turned[within] * 1e3


def _seams(out: Evaluation, commands: Sequence[RecordedSample]) -> None:
    """Steps of the command stream where a chunk replaces another."""
    goal_mm: list[float] = []
    velocity_mm_s: list[float] = []
    for before, after, apart_s, _ in _neighbours(commands):
        if before.cause and after.cause and _chunk(before.cause) != _chunk(after.cause):
            goal = after.goal_position_m - before.goal_position_m
            goal_mm.append(float(np.linalg.norm(goal)) * 1e3)
            # The step is what the acceleration does not explain.
            gained = (before.acceleration[:3] + after.acceleration[:3]) / 2 * apart_s
            step = after.twist[:3] - before.twist[:3] - gained
            velocity_mm_s.append(float(np.linalg.norm(step)) * 1e3)
    out.seam_goal_mm, out.seam_velocity_mm_s = np.array(goal_mm), np.array(velocity_mm_s)


def _neighbours(commands: Sequence[RecordedSample]) -> Iterator[tuple[Any, Any, float, int]]:
    """Commands that follow each other, the time the motion had between them in s, and how often.

    At rest commands are rarer than in motion: a motion begins one period of the stream before its
    first command, and two commands at rest count once for every period between them.
    """
    stamps_ns = np.array([sample.header.stamp_wall_ns for sample in commands], dtype=np.int64)
    gaps_s = np.diff(stamps_ns) / 1e9
    if not (gaps_s > 0).any():
        return
    period_s = float(np.quantile(gaps_s[gaps_s > 0], PERIOD_QUANTILE))
    for (one, two), gap_s in zip(pairwise(commands), gaps_s.tolist(), strict=True):
        if not 0 < gap_s < GAP_S:
            continue
        if _rests(one.record):
            times = max(round(gap_s / period_s), 1) if _rests(two.record) else 1
            yield one.record, two.record, min(gap_s, period_s), times
        else:
            yield one.record, two.record, gap_s, 1


def _rests(command: PoseCommand | JointCommand) -> bool:
    if isinstance(command, PoseCommand):
        return not (command.twist.any() or command.acceleration.any())
    return not (command.velocity_rad_s.any() or command.acceleration_rad_s2.any())


def _chunk(cause: Cause) -> tuple[str, int]:
    return cause.worker, cause.chunk_seq


def _jerk(out: Evaluation, run: Run) -> None:
    """Norm of the jerk of pose commands; without these, the largest of a joint."""
    jerk: list[float] = []
    for before, after, apart_s, times in _neighbours(run.commands or run.joint_commands):
        if isinstance(before, PoseCommand):
            size = np.linalg.norm(after.acceleration[:3] - before.acceleration[:3])
        else:
            size = np.abs(after.acceleration_rad_s2 - before.acceleration_rad_s2).max()
        jerk += [float(size) / apart_s] * times
    out.jerk = np.array(jerk)
    if jerk and not run.commands:
        out.jerk_unit = "rad_s3"


# -- activity -------------------------------------------------------------------------------------
def _idle(out: Evaluation, run: Run, measured: MeasuredMotion) -> None:
    active = run.activations()
    if not active:
        return
    out.active_s = out.idle_s = 0.0
    for since_ns, until_ns, _ in active:
        out.active_s += (until_ns - since_ns) / 1e9
        part = measured.part((since_ns - run.began_ns) / 1e9, (until_ns - run.began_ns) / 1e9)
        if len(part.t_s) > 1:
            speed = np.linalg.norm(part.twist[:-1, :3], axis=1)
            turn = np.linalg.norm(part.twist[:-1, 3:], axis=1)
            out.idle_s += idle_s(part.t_s, speed, turn)


def _counted(
    first: Mapping[str, NodeStatus], last: Mapping[str, NodeStatus], prefix: str
) -> Counter[str]:
    """Increase of the nodes' counters during the recording; from zero if a node restarted."""
    out: Counter[str] = Counter()
    for node, status in last.items():
        before = first[node]
        same = before.started_wall_ns == status.started_wall_ns
        for name, count in status.counters.items():
            if name.startswith(prefix):
                earlier = before.counters.get(name, 0) if same else 0
                out[name.removeprefix(prefix)] += count - earlier
    return +out


# -- prompts --------------------------------------------------------------------------------------
def _segments(
    out: Evaluation, run: Run, causes: Sequence[tuple[Cause, int]], measured: MeasuredMotion
) -> None:
    """A segment for each prompt in force while the arm was active."""
    zero_ns = run.began_ns
    steps = {(e.record.worker, e.header.seq): len(e.record.steps) for e in run.chunks}
    intervals = run.prompt_intervals()
    reads = {worker: run.reads_prompts(worker) for worker in {each[2] for each in intervals}}
    for since_ns, end_ns, worker, prompt in intervals:
        if reads[worker]:
            out.prompts.append(prompt)
        else:
            prompt = f"({worker})"
        since_s, until_s = (since_ns - zero_ns) / 1e9, (end_ns - zero_ns) / 1e9
        out.marks.append((since_s, prompt))
        part = measured.part(since_s, until_s)
        carried_out = sum(
            steps.get(_chunk(cause), 1)
            for cause, _ in causes
            if since_ns <= cause.received_ns < end_ns
        )
        low, high = np.searchsorted(out.width_t_s, (since_s, until_s))
        out.segments.append(
            segment(
                prompt,
                carried_out,
                until_s - since_s,
                part.position_m,
                part.quat_xyzw,
                out.width_m[low:high],
                _acted(run.events, since_ns, end_ns),
            )
        )


def _acted(events: Iterable[RecordedSample], since_ns: int, end_ns: int) -> tuple[str, ...]:
    """Limits that shortened the motion meanwhile, the most frequent first."""
    found = Counter(
        f"{event.record.what} {event.record.why}"
        for event in events
        if since_ns <= event.header.stamp_wall_ns < end_ns
        and (event.record.kind, event.record.level) == ("limit", "warning")
    )
    return tuple(f"{text} ({count} times)" for text, count in found.most_common(SHOWN_LIMITS))
