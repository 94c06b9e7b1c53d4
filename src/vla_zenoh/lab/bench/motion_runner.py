"""Runs the motion protocol through the real chain in real time."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import pose_of
from vla_zenoh.lab.bench.motion import (
    PREPARATION_HZ,
    WAY_HZ,
    Conditions,
    MeasuredStream,
    MotionCase,
    failed_row,
    make_row,
    path_length,
)
from vla_zenoh.lab.demo.runner import DemoRunner
from vla_zenoh.lab.demo.segments import make_segment
from vla_zenoh.lab.recording.run import first_commands
from vla_zenoh.lab.recording.stream_listener import StreamListener, Streams
from vla_zenoh.runtime.launch import Host

RESET_SETTLE_S = 0.3


def run_in_real_time(
    host: Host,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    progress: Callable[[MotionCase, Conditions, int], None],
) -> Iterator[tuple[dict[str, Any], Streams]]:
    """One row after the other, with its recorded streams.

    Args:
        host: up, with a simulator.
        trials: prompts.
        conditions: of each prompt; only the rate may differ, as the worker is running.
        stop: set by Ctrl-C.
        progress: called with case, conditions and accepted steps.

    Raises:
        NodeError: the chain does not come up.
        Interrupted: Ctrl-C.
    """
    assert host.session is not None and host.client is not None
    profile = host.profile
    for each in conditions:
        for trial in trials:
            listener = StreamListener(host.session, profile.keys, profile.task.worker)
            run = DemoRunner(
                host.client,
                listener,
                stop,
                host.poll,
                lambda _, done, trial=trial, each=each: progress(trial, each, done),
            )
            run.wait_until_ready()
            host.client.deactivate()
            run.reset_simulator()
            run.pause(RESET_SETTLE_S)
            run.start("hold", PREPARATION_HZ)
            try:
                if trial.preparation:
                    prepared = run.run_segment(
                        0, make_segment(trial.preparation, 1), PREPARATION_HZ
                    )
                    if prepared.faults():
                        raise NodeError(f"{trial.preparation}: {'; '.join(prepared.faults())}")
                host.client.set_rate(each.rate_hz)
                before = _refusals(host)
                since_ns = time.time_ns()
                outcome = run.run_segment(0, trial.segment, each.rate_hz)
            except NodeError as error:
                # The arm is at rest; the other prompts can still be measured.
                yield failed_row(trial, each, str(error)), listener.close()
                continue
            finally:
                host.client.deactivate()
            recording = listener.close()
            first = first_commands(recording.commands or recording.joint_commands)
            stream = stream_of(recording, first, since_ns, profile.timing.state_hz)
            refused = _refusals(host) - before
            yield make_row(trial, each, profile, outcome, stream, refused), recording


def _refusals(host: Host) -> Counter[str]:
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


def stream_of(
    recording: Streams, first: Sequence[tuple[Any, int]], since_ns: int, state_hz: float
) -> MeasuredStream:
    """The commanded motion since `since_ns`, as arrays."""
    commands = [entry for entry in recording.commands if entry.header.stamp_wall_ns >= since_ns]
    causes = [entry.record.cause for entry in commands]
    poses = [entry.record for entry in recording.poses if entry.header.stamp_wall_ns >= since_ns]
    tracking_m = max(
        (
            float(np.linalg.norm(pose.position_m - pose.reference_position_m))
            for pose in poses
            if pose.reference_position_m is not None
        ),
        default=0.0,
    )
    mine = [
        (cause, stamp_ns) for cause, stamp_ns in first if cause.observation_stamp_ns >= since_ns
    ]
    return MeasuredStream(
        np.array([entry.header.stamp_wall_ns - since_ns for entry in commands]) / 1e9,
        np.array([entry.record.twist for entry in commands]).reshape(-1, 6),
        np.array([entry.record.acceleration for entry in commands]).reshape(-1, 6),
        np.array([cause.chunk_seq if cause else -1 for cause in causes]),
        *path_length([pose_of(pose) for pose in poses[:: round(state_hz / WAY_HZ)]]),
        tracking_m,
        [(stamp_ns - cause.observation_stamp_ns) / 1e6 for cause, stamp_ns in mine],
        [(cause.received_ns - cause.observation_stamp_ns) / 1e6 for cause, _ in mine],
    )
