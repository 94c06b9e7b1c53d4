"""Intervals of a recording: when the arm obeyed which worker, and for which prompt.

They follow the stamps of the writers, not the reception, so a replayed run is divided as the
original is.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

from vla_zenoh.lab.recording.run import RecordedSample, Run
from vla_zenoh.types import Task


def obeyed_chunks(run: Run) -> list[RecordedSample]:
    """Chunks of the obeyed worker while the arm was active: the requests."""
    spans = activations(run)
    starts = [since_ns for since_ns, _, _ in spans]
    out: list[RecordedSample] = []
    for entry in run.chunks:
        stamp_ns = entry.header.stamp_wall_ns
        at = bisect_right(starts, stamp_ns) - 1
        if at >= 0 and stamp_ns < spans[at][1] and entry.record.worker == spans[at][2]:
            out.append(entry)
    return out


def activations(run: Run) -> list[tuple[int, int, str]]:
    """(since ns, until ns, worker) of each interval in which the arm obeyed one worker."""
    return _spans(run, lambda task: task.worker)


def prompt_intervals(run: Run) -> list[tuple[int, int, str]]:
    """(since ns, until ns, prompt) of each interval with one prompt in force."""
    return _spans(run, lambda task: task.prompt)


def _spans(run: Run, of: Callable[[Task], str]) -> list[tuple[int, int, str]]:
    out: list[tuple[int, int, str]] = []
    since_ns, now = 0, None
    for entry in run.tasks:
        value = of(entry.record) if entry.record.active else None
        if value != now:
            stamp_ns = entry.header.stamp_wall_ns
            if now is not None:
                out.append((since_ns, stamp_ns, now))
            since_ns, now = stamp_ns, value
    if now is not None:
        out.append((since_ns, last_ns(run) + 1, now))
    return out


def last_ns(run: Run) -> int:
    """The last stamp of robot and models; a recorder may run on after it."""
    streams = (run.tasks, run.chunks, run.commands, run.joint_commands, run.poses)
    stamps = (stream[-1].header.stamp_wall_ns for stream in streams if stream)
    return max(stamps, default=run.ended_ns)
