"""Runs the motion protocol in lockstep, one row per process.

Latencies are those of `Delays` and of waiting for the next image and tick; motion, limits and seams
are those of the nodes.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays
from vla_zenoh_benchmarks.task_lockstep import in_processes

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
from benchmarks.motion.segments import DemoSegment, RestPose, judge_segment, make_segment
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import PoseCommand

CAMERA_S, WIRE_S = 0.015, 0.0005
"""Camera stamp to worker, and every other link, about as measured in real time."""
WARM_UP_S, SETTLE_S, SLACK_S = 1.2, 1.0, 5.0
LOOK_S = 0.25

Row = dict[str, Any]


def run_in_lockstep(
    profile: Profile,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    *,
    processes: int | None = None,
) -> Iterator[Row]:
    """All rows, in the order of `conditions` and `trials`.

    Args:
        profile: of a robot that is commanded by poses.
        trials: prompts.
        conditions: of each prompt.
        stop: set by Ctrl-C; unfinished rows are dropped.
        processes: at once; None: one per core.

    Raises:
        NodeError: a process was killed.
    """
    jobs = [(profile, trial, each) for each in conditions for trial in trials]
    yield from in_processes(lockstep_row, jobs, stop, processes=processes)


def lockstep_row(profile: Profile, trial: MotionCase, conditions: Conditions) -> Row:
    """Run one case; one that does not end gives a failed row."""
    try:
        return _row(profile, trial, conditions)
    except NodeError as error:
        return failed_row(trial, conditions, str(error))


def _row(profile: Profile, trial: MotionCase, conditions: Conditions) -> Row:
    dt_s = 0.1
    options = {"horizon": str(conditions.horizon), "dt_s": str(dt_s)}
    loop = Lockstep(
        profile,
        build_world(profile),
        make_policy(find_model("scripted"), options),
        delays=Delays(conditions.delay_ms / 1e3, conditions.jitter, CAMERA_S, wire_s=WIRE_S),
        reach=ReachabilityFilter(profile),
    )
    loop.put("rate", PREPARATION_HZ)
    loop.run(WARM_UP_S)
    loop.put("active", True)
    loop.run(LOOK_S)
    if trial.preparation:
        _run_segment(loop, make_segment(trial.preparation, 1), PREPARATION_HZ)
    loop.put("rate", conditions.rate_hz)
    loop.run(1.0 / PREPARATION_HZ)
    before, since = _rest_pose(loop), len(loop.trace.time_ns)
    steps_done = _run_segment(loop, trial.segment, conditions.rate_hz)
    outcome = judge_segment(
        trial.segment,
        before,
        _rest_pose(loop),
        max_width_m=profile.robot.gripper.max_width_m,
        steps_done=steps_done,
        duration_s=(loop.now_ns - loop.trace.time_ns[since]) / 1e9 - SETTLE_S,
    )
    return make_row(trial, conditions, profile, outcome, _stream(loop, since))


def _run_segment(loop: Lockstep, segment: DemoSegment, rate_hz: float) -> int:
    """Publish the prompt and run until rest after its last step; the accepted steps."""
    commander, limit_s = loop.commander, segment.steps / rate_hz * 2 + SLACK_S
    episode = commander.task.episode
    loop.put("prompt", segment.prompt_with_count)
    ended = loop.run_until(
        lambda: commander.task.episode != episode and commander.progress.done and commander.at_rest,
        limit_s,
    )
    if not ended or commander.state.value not in ("active", "holding"):
        raise NodeError(
            f"{segment.prompt_with_count!r} at {rate_hz:g} Hz did not end in {limit_s:.0f} s: the "
            f"command node is {commander.state.value} ({commander.why}), rejected: "
            f"{dict(loop.refused) or 'nothing'}"
        )
    loop.run(SETTLE_S)
    return commander.progress.steps


def _rest_pose(loop: Lockstep) -> RestPose:
    return RestPose(Pose(*loop.world.tcp()), loop.world.gripper_state().width_m)


def _stream(loop: Lockstep, since: int) -> MeasuredStream:
    trace, period_s = loop.trace, 1.0 / loop.profile.timing.command_hz
    sent: list[tuple[int, PoseCommand]] = []
    tracking_m = 0.0
    for index in range(since, len(trace.time_ns)):
        command, before = trace.commands[index], trace.commands[index - 1]
        if before is not None:
            # The measured pose of this tick follows the command of the one before.
            there_m = before.position_m + before.twist[:3] * period_s
            away_m = float(np.linalg.norm(trace.position_m[index] - there_m))
            tracking_m = max(tracking_m, away_m)
        if command is not None:
            sent.append((trace.time_ns[index], command))
    first: dict[int, tuple[float, float]] = {}
    for time_ns, command in sent:
        cause = command.cause
        if cause is not None and cause.observation_stamp_ns >= trace.time_ns[since]:
            times = (
                (time_ns - cause.observation_stamp_ns) / 1e6,
                (cause.received_ns - cause.observation_stamp_ns) / 1e6,
            )
            first.setdefault(cause.chunk_seq, times)
    every = round(loop.profile.timing.command_hz / WAY_HZ)
    places = zip(trace.position_m[since::every], trace.rotation[since::every], strict=True)
    return MeasuredStream(
        np.array([time_ns - trace.time_ns[since] for time_ns, _ in sent]) / 1e9,
        np.array([command.twist for _, command in sent]).reshape(-1, 6),
        np.array([command.acceleration for _, command in sent]).reshape(-1, 6),
        np.array([command.cause.chunk_seq if command.cause else -1 for _, command in sent]),
        *path_length([Pose(*place) for place in places]),
        tracking_m,
        [end_to_end for end_to_end, _ in first.values()],
        [outbound for _, outbound in first.values()],
    )
