"""One episode of a benchmark: in lockstep with the model, or with a clock that does not wait."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from vla_zenoh.lab.benchmark.contract import Benchmark, raw_steps
from vla_zenoh.lab.benchmark.episode_clock import (
    Asked,
    EpisodeClock,
    EpisodeConditions,
    EpisodeOutcome,
    EpisodeRequest,
    state_hash,
)
from vla_zenoh.types import FloatArray


def run_episode(
    benchmark: Benchmark, request: EpisodeRequest, worker: Asked, conditions: EpisodeConditions
) -> EpisodeOutcome:
    """Run an episode; the model is asked by `worker`.

    Raises:
        NodeError: the worker does not answer.
        SpecError: its actions are not the benchmark's.
    """
    began_s = time.perf_counter()
    benchmark.reset(request.suite, request.task.name, request.episode)
    worker.begin(request.task.prompt)
    clock = EpisodeClock(benchmark, request, worker)
    if conditions.mode == "command":
        from vla_zenoh.lab.benchmark.command_path import run_through_command_node

        run_through_command_node(clock, conditions)
        return clock.finish(began_s)
    while not clock.over:
        steps = raw_steps(clock.ask(), clock.spec.action, benchmark.action)
        # Before its first chunk the arm is not active yet, and the clock stands.
        if conditions.mode == "live" and clock.outcome.steps:
            given_s = None if conditions.delay_ms is None else conditions.delay_ms / 1e3
            delay_s = clock.asked_s if given_s is None else given_s
            clock.stand(math.ceil(round(delay_s / benchmark.action.dt_s, 6)))
        for action in steps[: conditions.replan or None]:
            clock.step(action)
    return clock.finish(began_s)


def replay_episode(
    benchmark: Benchmark,
    request: EpisodeRequest,
    actions: Sequence[FloatArray],
    look: Callable[[int], None] = lambda step: None,
) -> EpisodeOutcome:
    """Execute recorded steps from the same initial state, without a model.

    Args:
        benchmark: in which.
        request: whose steps they are.
        actions: every step.
        look: called with the number of steps so far, 0 first.
    """
    began_s = time.perf_counter()
    benchmark.reset(request.suite, request.task.name, request.episode)
    out = EpisodeOutcome(request.suite, request.task.name, request.episode)
    look(0)
    for action in actions:
        out.success = bool(benchmark.step(action))
        out.steps += 1
        look(out.steps)
    out.wall_s, out.end = time.perf_counter() - began_s, state_hash(benchmark)
    out.failure = "" if out.success else "steps"
    return out
