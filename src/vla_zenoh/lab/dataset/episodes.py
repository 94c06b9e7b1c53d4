"""Episodes of a run: one for each interval in which the arm obeyed one worker.

A frame is one step of that worker's chunks: step k of a chunk belongs to the stamp of its
observation plus k steps. Steps that a newer chunk replaced are left out. If a chunk ran out before
the next one arrived, frames without motion fill the gap, so all frames are `dt_s` apart.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import as_deltas
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.activations import activations, obeyed_chunks
from vla_zenoh.lab.recording.run import RecordedSample, Run
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec, ModelSpec

FPS_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One time step.

    Args:
        stamp_ns: wall clock.
        action: (D,) float32, with the meaning of the spec.
        prompt: in force at that time.
    """

    stamp_ns: int
    action: NDArray[np.float32]
    prompt: str


@dataclass(slots=True)
class RecordedEpisode:
    """An interval in which the arm obeyed one worker, as frames.

    Args:
        run: the recorded run.
        worker: the obeyed worker.
        spec: of its actions.
        since_ns: start, wall clock.
        until_ns: end, wall clock.
        frames: oldest first.
        success: whether the task was done; None: unknown.
    """

    run: Run
    worker: str
    spec: ModelSpec
    since_ns: int
    until_ns: int
    frames: list[Frame] = field(default_factory=list)
    success: bool | None = None


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
        run: the recorded run.
        worker: only episodes of this worker.

    Raises:
        RecordingError: a chunk's spec is not in the recording.
    """
    done = {
        (cause.worker, cause.chunk_seq, cause.observation_stamp_ns)
        for cause, _ in run.first_commands()
    }
    carried_out = [
        chunk
        for chunk in obeyed_chunks(run)
        if (chunk.record.worker, chunk.header.seq, chunk.record.observation_stamp_ns) in done
    ]
    out: list[RecordedEpisode] = []
    for since_ns, until_ns, whose in activations(run):
        chunks = [
            chunk
            for chunk in carried_out
            if since_ns <= chunk.header.stamp_wall_ns < until_ns and chunk.record.worker == whose
        ]
        if not chunks or worker not in (None, whose):
            continue
        spec, chunks = _one_by_one(_spec_of(run, chunks), chunks)
        frames = _frames(run, spec.action, chunks, until_ns)
        out.append(RecordedEpisode(run, whose, spec, since_ns, until_ns, frames))
    return out


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


def _one_by_one(
    spec: ModelSpec, chunks: list[RecordedSample]
) -> tuple[ModelSpec, list[RecordedSample]]:
    """Chunks whose steps mean something one by one, also apart from the start of their chunk."""
    if spec.action.relative_to == "previous":
        return spec, chunks
    action, out = spec.action, []
    for chunk in chunks:
        action, steps = as_deltas(spec.action, chunk.record.steps)
        record = replace(chunk.record, steps=steps.astype(np.float32))
        out.append(chunk._replace(record=record))
    return spec.model_copy(update={"action": action}), out


def _frames(run: Run, spec: ActionSpec, chunks: list[RecordedSample], until_ns: int) -> list[Frame]:
    stamps = [entry.header.stamp_wall_ns for entry in run.tasks]
    prompts = [entry.record.prompt for entry in run.tasks]
    dt_ns = round(spec.dt_s * 1e9)
    begins = [chunk.record.observation_stamp_ns for chunk in chunks]
    ends = [*begins[1:], until_ns]
    out: list[Frame] = []
    for chunk, begin_ns, end_ns in zip(chunks, begins, ends, strict=True):
        steps = chunk.record.steps
        count = max(round((end_ns - begin_ns) / dt_ns), 1)
        if chunk is chunks[-1]:
            count = min(count, len(steps))
        rest = hold(spec, steps[-1])
        for index in range(count):
            at_ns = begin_ns + index * dt_ns
            # A chunk's observation may be from just before the activation.
            task = max(bisect_right(stamps, max(at_ns, chunk.header.stamp_wall_ns)) - 1, 0)
            action = steps[index] if index < len(steps) else rest
            out.append(Frame(at_ns, action, prompts[task]))
    return out


def hold(spec: ActionSpec, last: NDArray[np.float32]) -> NDArray[np.float32]:
    """(D,) the step without motion after `last`."""
    if spec.kind == "absolute":
        out = last.copy()
    else:
        out = np.zeros_like(last)
        if spec.space == "tcp" and spec.rotation == "quaternion":
            out[2 + ROTATION_SIZE["quaternion"]] = 1.0
    if spec.gripper == "delta_m":
        out[-1] = 0.0
    elif spec.gripper != "none":
        out[-1] = last[-1]
    return out
