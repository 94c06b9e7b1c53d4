"""Episodes of a run: one for each interval in which the arm obeyed one worker.

A frame is one step of that worker's chunks: step k of a chunk belongs to the stamp of its
observation plus k steps. Steps that a newer chunk replaced are left out. If a chunk ran out before
the next one arrived, frames without motion fill the gap, so all frames are `dt_s` apart. At a speed
override of a share s a step takes dt_s / s: the frames are those of the same motion at full speed.
So are they where chunks of one delta came sooner than a step lasts: the arm executed each of them
as a whole, faster than the steps say, and each is a frame.

Where a person took the arm from a model and gave it back, without a deactivation in between, that
is one episode of the model. The frames that the person led are what the arm was commanded to do,
in the numbers of the model's spec (`vla_zenoh_dataset.corrections`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import as_deltas
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.run import RecordedSample, Run, Span, is_within, newest
from vla_zenoh.policy import ActionSpec, ModelSpec, standing_step
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.policy.plan_clock import idle_time, least_steps
from vla_zenoh.policy.spec import PERSON
from vla_zenoh.types import Header
from vla_zenoh_dataset.corrections import commanded_motion
from vla_zenoh_dataset.label import EpisodeLabel

FPS_TOLERANCE = 0.01
HALF_A_STEP = 0.5 + 1e-6
"""As far as time runs ahead for a step that did not have half its time, so that it is counted."""


class EpisodeGap(RecordingError):
    """Something was not recorded while one episode lasted; others may have it."""


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeFrame:
    """One time step. `action`: (D,) float32, with the meaning of the spec."""

    stamp_ns: int
    action: NDArray[np.float32]
    prompt: str
    intervention: bool = False


@dataclass(slots=True)
class RecordedEpisode:
    """An interval in which the arm obeyed one worker, and maybe a person, as frames.

    Args:
        worker: the obeyed worker; the model, where a person took the arm from it.
        since_ns: start, wall clock.
        until_ns: end, wall clock.
        frames: oldest first.
        led: who led when, oldest first.
        success: whether the task was done; None: unknown.
        discarded: a person called it void.
    """

    run: Run
    worker: str
    spec: ModelSpec
    since_ns: int
    until_ns: int
    frames: list[EpisodeFrame] = field(default_factory=list)
    led: list[Span] = field(default_factory=list)
    success: bool | None = None
    discarded: bool = False

    @property
    def label(self) -> EpisodeLabel:
        if self.discarded:
            return EpisodeLabel.DISCARDED
        if self.success is None:
            return EpisodeLabel.UNKNOWN
        return EpisodeLabel.SUCCESS if self.success else EpisodeLabel.FAILURE

    @property
    def named(self) -> str:
        """Which one it is, in words: when it began, of which recording."""
        return f"{self.run.path}: the episode at {self.after_s(self.since_ns):.1f} s"

    @property
    def is_over(self) -> bool:
        """Whether the recording has its end, rather than ending before."""
        return self.run.tasks[-1].header.stamp_wall_ns >= self.until_ns

    def is_copy_of(self, other: RecordedEpisode) -> bool:
        """Whether both are of one robot at one time: by the process that commanded it."""
        if self.until_ns <= other.since_ns or other.until_ns <= self.since_ns:
            return False
        one, two = (newest(each.run.tasks, each.since_ns) for each in (self, other))
        return one is not None and two is not None and one.header.source == two.header.source

    def after_s(self, at_ns: int) -> float:
        """Seconds from the beginning of the recording to a time, wall clock."""
        return (at_ns - self.run.began_ns) / 1e9

    @property
    def workers(self) -> list[str]:
        """All that led, the first one first."""
        return list(dict.fromkeys(worker for _, _, worker in self.led))


def fps_of(spec: ActionSpec) -> int:
    """Frames per second.

    Raises:
        RecordingError: steps of this length have no whole number of frames per second.
    """
    fps = round(1 / spec.dt_s)
    if fps < 1 or abs(fps * spec.dt_s - 1) > FPS_TOLERANCE:
        raise RecordingError(
            f"steps of {spec.dt_s:g} s are {1 / spec.dt_s:.3g} per second, and a LeRobot dataset "
            "wants a whole number: choose another dt_s for the worker"
        )
    return fps


def episodes_of(run: Run, worker: str | None = None) -> list[RecordedEpisode]:
    """All episodes with frames.

    Args:
        worker: only episodes of this worker; of a person's, only what the person led.

    Raises:
        RecordingError: a chunk's spec is not in the recording, a person's motion cannot be told in
            the numbers of the model's spec, or a clock was set back.
    """
    if steps := run.file.clock_steps:
        raise RecordingError(
            f"{run.path}: {steps[0]}. Which state belongs to which action is unknown; "
            "leave this recording out, and synchronise the clocks (`vla-zenoh doctor`) before the "
            "next one"
        )
    done = {
        (cause.worker, cause.chunk_seq, cause.observation_stamp_ns)
        for cause, _ in run.first_commands()
    }
    carried_out = [
        chunk
        for chunk in run.obeyed_chunks()
        if (chunk.record.worker, chunk.header.seq, chunk.record.observation_stamp_ns) in done
    ]
    people = _people(run)
    spans = [span for span in run.activations() if _within(span, carried_out)]
    alone = worker in people
    out: list[RecordedEpisode] = []
    for led in [[span] for span in spans] if alone else together(spans, people):
        whose = next((each for _, _, each in led if each not in people), led[0][2])
        if worker in (None, whose):
            out.append(_episode(run, whose, led, carried_out, people))
    return [episode for episode in out if episode.frames]


def without_copies(
    episodes: Sequence[RecordedEpisode],
) -> tuple[list[RecordedEpisode], list[str]]:
    """Each episode once, and which were left out: recordings overlap where two recorders ran, or a
    rolling record was saved twice. A copy with a label is kept, of those the longest, and of those
    one of a finished recording."""
    kept: list[RecordedEpisode] = []
    copies: list[str] = []

    def merit(each: RecordedEpisode) -> tuple[bool, int, bool]:
        unfinished = each.run.file.ended is None
        return each.label == EpisodeLabel.UNKNOWN, -len(each.frames), unfinished

    for episode in sorted(episodes, key=merit):
        same = next((each for each in kept if each.is_copy_of(episode)), None)
        if same is None:
            kept.append(episode)
        else:
            copies.append(f"{episode.named} is in {same.run.path} as well, and is taken from there")
    return [each for each in episodes if any(each is one for one in kept)], copies


def _people(run: Run) -> set[str]:
    known = {(chunk.record.worker, chunk.record.spec_hash) for chunk in run.chunks}
    return {
        worker for worker, spec in known if spec in run.specs and run.specs[spec].name == PERSON
    }


def _within(span: Span, chunks: list[RecordedSample]) -> list[RecordedSample]:
    """Those of the worker and the time of a span."""
    return [chunk for chunk in chunks if is_within(chunk, span)]


def together(spans: list[Span], people: set[str]) -> list[list[Span]]:
    """Spans of one model and the people who took the arm from it while it was active."""
    out: list[list[Span]] = []
    for span in spans:
        if out and out[-1][-1][1] == span[0] and _goes_on(out[-1], span[2], people):
            out[-1].append(span)
        else:
            out.append([span])
    return out


def _goes_on(led: list[Span], worker: str, people: set[str]) -> bool:
    """Whether what `worker` leads next belongs to the same episode."""
    models = {each for _, _, each in led} - people
    if not models and worker in people:
        return worker == led[-1][2]
    return len(models | ({worker} - people)) <= 1


def _episode(
    run: Run, whose: str, led: list[Span], carried_out: list[RecordedSample], people: set[str]
) -> RecordedEpisode:
    own = [chunk for span in led if span[2] == whose for chunk in _within(span, carried_out)]
    spec, own = _one_by_one(run, *_in_order_of_profile(run, _spec_of(run, own), own))
    mixed = any(worker != whose for _, _, worker in led)
    motion = commanded_motion(run, spec.action) if mixed else None
    parts = [(span, _within(span, own)) for span in led]
    followed = [chunk for span in led for chunk in _within(span, carried_out)]
    dt_s = {key: each.action.dt_s for key, each in run.specs.items()}
    begun = step_begins(run.tasks, followed, dt_s)
    begins = [begun[chunks[0].header] if chunks else span[0] for span, chunks in parts]
    ends = [*begins[1:], led[-1][1]]
    frames: list[EpisodeFrame] = []
    whole = _whole_steps(run, followed, [*begun.values(), ends[-1]])
    clock = StepClock(run.tasks, begins[0], ends[-1], spec.action.dt_s, whole)
    for (span, chunks), end_ns in zip(parts, ends, strict=True):
        person = span[2] in people
        if chunks:
            last = span is led[-1]
            timed = ([(chunk, begun[chunk.header]) for chunk in chunks], end_ns, clock)
            frames += _frames(run, spec.action, timed, person=person, to_the_end=not last)
        elif motion is not None:
            stamps = [clock.when_ns(at) for at in range(len(frames), clock.count(end_ns) + 1)]
            frames += [
                EpisodeFrame(at_ns, motion(at_ns, next_ns), _prompt(run, at_ns), person)
                for at_ns, next_ns in pairwise(stamps)
            ]
    return RecordedEpisode(run, whose, spec, led[0][0], led[-1][1], frames, led)


def _spec_of(run: Run, chunks: list[RecordedSample]) -> ModelSpec:
    hashes = {chunk.record.spec_hash for chunk in chunks}
    specs = [run.specs[each] for each in hashes if each in run.specs]
    if len(specs) != len(hashes):
        raise RecordingError(
            f"{run.path}: the spec of worker {chunks[0].record.worker!r} is not in it, so the "
            "meaning of its actions is unknown; record a second or more before activating"
        )
    if len(specs) > 1:
        raise RecordingError(
            f"{run.path}: worker {chunks[0].record.worker!r} changed what its actions mean within "
            "one activation"
        )
    return specs[0]


def _in_order_of_profile(
    run: Run, spec: ModelSpec, chunks: list[RecordedSample]
) -> tuple[ModelSpec, list[RecordedSample]]:
    """Columns of joints in the order of the profile, in which a policy is told its state.

    A model may name its joints in another order; a policy that is trained on the data is asked for
    them in this one.
    """
    order, parts = np.arange(spec.action.dimension), {}
    for part in spec.parts:
        own = parts[part] = spec.action.of(part)
        joints = tuple(run.of_part(part).profile.robot.arm_joints) if own.joints else ()
        if set(joints) != set(own.joints):  # never of a command node, which rejects such a spec
            continue
        begin = spec.action.columns(part).start
        order[begin : begin + len(joints)] = [begin + own.joints.index(name) for name in joints]
        parts[part] = own.model_copy(update={"joints": joints})
    action = ActionSpec.of_parts(parts) if spec.action.parts else parts[""]
    if action == spec.action:
        return spec, chunks
    out = [
        chunk._replace(record=replace(chunk.record, steps=chunk.record.steps[:, order]))
        for chunk in chunks
    ]
    return spec.model_copy(update={"action": action}), out


def _one_by_one(
    run: Run, spec: ModelSpec, chunks: list[RecordedSample]
) -> tuple[ModelSpec, list[RecordedSample]]:
    """Chunks whose steps mean something one by one, also apart from the start of their chunk."""
    if all(spec.action.of(part).relative_to == "previous" for part in spec.parts):
        return spec, chunks
    action, out = spec.action, []
    for chunk in chunks:
        action, steps = _as_deltas(run, spec.action, chunk.record.steps)
        record = replace(chunk.record, steps=steps.astype(np.float32))
        out.append(chunk._replace(record=record))
    return spec.model_copy(update={"action": action}), out


def endless_joints(run: Run, spec: ActionSpec, part: str) -> NDArray[np.bool_]:
    """Which of the joints (n,) of a part's actions turn without an end."""
    measured = run.of_part(part).joints
    endless = measured[0].record.endless if measured else ()
    return np.array([name in endless for name in spec.joints], bool)


def _as_deltas(
    run: Run, spec: ActionSpec, steps: NDArray[np.float32]
) -> tuple[ActionSpec, NDArray[np.float64]]:
    """`as_deltas` of every part."""
    if not spec.parts:
        return _deltas(run, spec, steps, "")
    own = {
        each.part: _deltas(run, each.action, steps[:, spec.columns(each.part)], each.part)
        for each in spec.parts
    }
    action = ActionSpec.of_parts({part: meant for part, (meant, _) in own.items()})
    return action, np.concatenate([rows for _, rows in own.values()], axis=1)


def _deltas(
    run: Run, spec: ActionSpec, steps: NDArray[np.float32], part: str
) -> tuple[ActionSpec, NDArray[np.float64]]:
    """`as_deltas` of one part; joints without an end go the shortest way, as they are moved."""
    action, rows = as_deltas(spec, steps)
    if spec.relative_to == "start":
        endless = np.flatnonzero(endless_joints(run, spec, part))
        rows[:, endless] = wrapped(rows[:, endless])
    return action, rows


def _whole_steps(
    run: Run, followed: Sequence[RecordedSample], times_ns: Sequence[int]
) -> list[tuple[int, int]]:
    """When chunks of one delta were in force, from their begins and the end; not of the last one,
    which the end of the episode may have cut."""
    whole: list[tuple[int, int]] = []
    for chunk, since_ns, until_ns in zip(followed[:-1], times_ns, times_ns[1:], strict=False):
        spec, count = run.specs[chunk.record.spec_hash], len(chunk.record.steps)
        adds = any(spec.action.of(part).kind == "delta" for part in spec.parts)
        if adds and least_steps(spec.action, count):
            whole.append((since_ns, until_ns))
    return whole


class StepClock:
    """Steps of an episode in time, at the speed override in force.

    Args:
        tasks: of the run, oldest first.
        begin_ns, end_ns: of the episode, wall clock.
        dt_s: of a step at full speed.
        whole: from when to when something was in force that counts as a step at least, oldest
            first, wall clock.
    """

    def __init__(
        self,
        tasks: Sequence[RecordedSample],
        begin_ns: int,
        end_ns: int,
        dt_s: float,
        whole: Sequence[tuple[int, int]] = (),
    ) -> None:
        self._begin_ns = begin_ns
        first = newest(tasks, begin_ns) or tasks[0]
        shares = {begin_ns: first.record.speed}
        for task in tasks:
            if begin_ns < task.header.stamp_wall_ns < end_ns:
                shares[task.header.stamp_wall_ns] = task.record.speed
        self._passed_s = (np.array([*shares, end_ns]) - begin_ns) / 1e9
        each = np.diff(self._passed_s) * np.array([*shares.values()]) / dt_s
        self._steps = np.concatenate([[0.0], np.cumsum(each)])
        times_s, ahead = [0.0], [0.0]
        for since_ns, until_ns in whole:
            since, until = (self.steps(at_ns) + ahead[-1] for at_ns in (since_ns, until_ns))
            if since < until and round(since) == round(until):
                times_s += [(at_ns - begin_ns) / 1e9 for at_ns in (since_ns, until_ns)]
                ahead += [ahead[-1], ahead[-1] + round(since) + HALF_A_STEP - until]
        passed_s = np.unique([*self._passed_s, *times_s])
        self._steps = np.interp(passed_s, self._passed_s, self._steps)
        self._steps += np.interp(passed_s, times_s, ahead)
        self._passed_s = passed_s

    def steps(self, at_ns: int) -> float:
        """How many steps have passed at a time."""
        return float(np.interp((at_ns - self._begin_ns) / 1e9, self._passed_s, self._steps))

    def count(self, at_ns: int) -> int:
        """`steps` as a whole number: however often chunks come, no step is counted twice."""
        return round(self.steps(at_ns))

    def when_ns(self, steps: float) -> int:
        """When so many steps have passed, wall clock."""
        return self._begin_ns + round(np.interp(steps, self._steps, self._passed_s) * 1e9)


def step_begins(
    tasks: Sequence[RecordedSample], followed: Sequence[RecordedSample], dt_s: Mapping[str, float]
) -> dict[Header, int]:
    """When the first step of each chunk began, wall clock, see `vla_zenoh.policy.plan_clock`.

    Args:
        tasks: of the run, oldest first.
        followed: chunks that the arm followed, in order.
        dt_s: duration of a step by the hash of its spec.
    """
    if not followed:
        return {}
    begins: dict[Header, int] = {}
    runs: list[tuple[float, float]] = []
    since_ns = followed[0].record.observation_stamp_ns
    clock = StepClock(tasks, since_ns, followed[-1].header.stamp_wall_ns, 1.0)
    for chunk in followed:
        record, published_ns = chunk.record, chunk.header.stamp_wall_ns
        seen, published = clock.steps(record.observation_stamp_ns), clock.steps(published_ns)
        begin = seen + idle_time(seen, published, runs)
        runs = [*runs[-1:], (published, begin + len(record.steps) * dt_s[record.spec_hash])]
        begins[chunk.header] = clock.when_ns(begin)
    return begins


def _frames(
    run: Run,
    spec: ActionSpec,
    timed: tuple[list[tuple[RecordedSample, int]], int, StepClock],
    *,
    person: bool = False,
    to_the_end: bool = False,
) -> list[EpisodeFrame]:
    """Frames of chunks, each from its begin, until a time; the last one not beyond its steps."""
    chunks, until_ns, clock = timed
    ends = [*(begin_ns for _, begin_ns in chunks[1:]), until_ns]
    out: list[EpisodeFrame] = []
    for (chunk, begin_ns), end_ns in zip(chunks, ends, strict=True):
        steps = chunk.record.steps
        count = clock.count(end_ns) - clock.count(begin_ns)
        if chunk is chunks[-1][0] and not to_the_end:
            count = min(count, len(steps))
        rest = standing_step(spec, steps[-1])
        for index in range(count):
            at_ns = clock.when_ns(clock.steps(begin_ns) + index)
            # A chunk's observation may be from just before the activation.
            prompt = _prompt(run, max(at_ns, chunk.header.stamp_wall_ns))
            action = steps[index] if index < len(steps) else rest
            out.append(EpisodeFrame(at_ns, action, prompt, person))
    return out


def _prompt(run: Run, at_ns: int) -> str:
    """In force at a time; before the first task, its own."""
    task = newest(run.tasks, at_ns) or run.tasks[0]
    return task.record.prompt
