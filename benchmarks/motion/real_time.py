"""Runs the motion protocol through the real chain in real time."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.motion.protocol import (
    PREPARATION_HZ,
    WAY_HZ,
    Conditions,
    MeasuredStream,
    MotionCase,
    failed_row,
    make_row,
    path_length,
)
from benchmarks.motion.runner import MotionRunner
from benchmarks.motion.segments import make_segment
from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import pose_of
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run
from vla_zenoh.runtime.launch import Host

RESET_SETTLE_S = 0.3
RECORDED = ("state/*", "command/*", "task", "prompt")


def run_in_real_time(
    host: Host,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    folder: Path,
    progress: Callable[[MotionCase, Conditions, int], None],
) -> Iterator[tuple[dict[str, Any], Run]]:
    """One row after the other, with what was recorded of it.

    Args:
        host: up, with a simulator.
        trials: prompts.
        conditions: of each prompt; only the rate may differ, as the worker is running.
        stop: set by Ctrl-C.
        folder: for the recordings.
        progress: called with case, conditions and accepted steps.

    Raises:
        NodeError: the chain does not come up.
        Interrupted: Ctrl-C.
    """
    assert host.session is not None
    assert host.client is not None
    run = MotionRunner(host.client, stop, host.poll)
    keys = host.profile.keys
    jobs = [(trial, each) for each in conditions for trial in trials]
    for number, (trial, each) in enumerate(jobs):
        path = folder / f"{number:04d}-{each.horizon}.mcap"
        recorder = Recorder(
            host.profile,
            host.session,
            path,
            expressions=[keys.full(key) for key in RECORDED],
            name=f"recorder{number}",
        ).start()
        why, outcome, since_ns, rejected = "", None, 0, Counter[str]()
        try:
            _prepare(host, run, trial)
            host.client.set_rate(each.rate_hz)
            before, since_ns = _rejections(host), time.time_ns()
            outcome = run.run_segment(trial.segment, each.rate_hz, partial(progress, trial, each))
            rejected = _rejections(host) - before
        except NodeError as error:
            why = str(error)  # the arm is at rest; the other prompts can still be measured
        finally:
            host.client.deactivate()
            recorder.close()
        recorded = load_run(path)
        if outcome is None:
            yield failed_row(trial, each, why), recorded
        else:
            stream = stream_of(recorded, since_ns, host.profile.timing.state_hz)
            yield make_row(trial, each, host.profile, outcome, stream, rejected), recorded


def _prepare(host: Host, run: MotionRunner, trial: MotionCase) -> None:
    """Bring the arm to the start of a case, active."""
    assert host.client is not None
    host.client.deactivate()
    run.reset_simulator()
    run.pause(RESET_SETTLE_S)
    run.begin(PREPARATION_HZ)
    if trial.preparation:
        prepared = run.run_segment(make_segment(trial.preparation, 1), PREPARATION_HZ)
        if prepared.faults():
            raise NodeError(f"{trial.preparation}: {'; '.join(prepared.faults())}")


def _rejections(host: Host) -> Counter[str]:
    """Rejections of every node so far, by ``node.reason``."""
    assert host.client is not None
    return Counter(
        {
            f"{node}.{name.removeprefix('refused.')}": count
            for node, (status, _, _) in host.client.snapshot().items()
            for name, count in status.counters.items()
            if name.startswith("refused.")
        }
    )


def stream_of(run: Run, since_ns: int, state_hz: float) -> MeasuredStream:
    """The commanded motion of a recording since `since_ns`, as arrays."""
    commands = [entry for entry in run.commands if entry.header.stamp_wall_ns >= since_ns]
    causes = [entry.record.cause for entry in commands]
    states = [entry for entry in run.poses if entry.header.stamp_wall_ns >= since_ns]
    tracking_m = max(
        (
            float(np.linalg.norm(entry.record.position_m - entry.record.reference_position_m))
            for entry in states
            if entry.record.reference_position_m is not None
        ),
        default=0.0,
    )
    mine = [
        (cause, stamp_ns)
        for cause, stamp_ns in run.first_commands()
        if cause.observation_stamp_ns >= since_ns
    ]
    return MeasuredStream(
        np.array([entry.header.stamp_wall_ns - since_ns for entry in commands]) / 1e9,
        np.array([entry.record.twist for entry in commands]).reshape(-1, 6),
        np.array([entry.record.acceleration for entry in commands]).reshape(-1, 6),
        np.array([cause.chunk_seq if cause else -1 for cause in causes]),
        *path_length([pose_of(entry.record) for entry in states[:: round(state_hz / WAY_HZ)]]),
        tracking_m,
        [(stamp_ns - cause.observation_stamp_ns) / 1e6 for cause, stamp_ns in mine],
        [(cause.received_ns - cause.observation_stamp_ns) / 1e6 for cause, _ in mine],
    )
