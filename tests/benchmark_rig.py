"""A worker for `examples/own_benchmark.py`, and a way to ask it without a bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from vla_zenoh_benchmarks.contract import Benchmark, BenchmarkObservation, make_benchmark
from vla_zenoh_benchmarks.episode import EpisodeRequest

from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.policy.loader import find_model
from vla_zenoh.types import ActionChunk

ROOT = Path(__file__).resolve().parents[1]
OWN_BENCHMARK = ROOT / "examples" / "own_benchmark.py"
HORIZON, DT_S, LARGEST_M = 3, 0.05, 0.02

REACHER = '''
"""Goes straight to the mark that only a simulation knows."""
import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec


class Reacher:
    spec = ModelSpec(
        name="reacher",
        observation=ObservationSpec(state=("pose", "privileged")),
        action=ActionSpec(horizon=3, dt_s=0.05, rotation="rotvec", gripper="none"),
    )

    def infer(self, observation):
        if self.fails and "far" in observation.prompt:
            raise ValueError("too far")
        away_m = observation.privileged.values["mark"] - observation.pose.position_m
        steps = np.zeros((3, 6))
        for row in steps:
            row[:3] = np.clip(away_m, -0.02, 0.02)
            away_m = away_m - row[:3]
        return ActionSteps(steps)

    def __init__(self, fails=""):
        self.fails = fails
'''


def own_benchmark() -> Benchmark:
    """The example's benchmark."""
    return make_benchmark(find_model(str(OWN_BENCHMARK)))


def request(task: str = "far", episode: int = 0, **changes: int) -> EpisodeRequest:
    """An episode of the example."""
    from dataclasses import replace

    found = next(each for each in own_benchmark().tasks("reach") if each.name == task)
    return EpisodeRequest("reach", replace(found, **changes), episode)


class Reacher:
    """Answers as the worker does, in this process.

    Args:
        steps: of a chunk.
        changes: of its action spec.
    """

    def __init__(self, steps: int = HORIZON, **changes: object) -> None:
        action = {"horizon": steps, "dt_s": DT_S, "rotation": "rotvec", "gripper": "none"}
        action |= {"anchor": "measured"}  # what it reads is measured
        self.spec = ModelSpec(
            name="reacher",
            observation=ObservationSpec(state=("pose", "privileged")),
            action=ActionSpec(**{**action, **changes}),  # pyright: ignore[reportArgumentType]
        )
        self.worker = "reacher"
        self.asked: list[BenchmarkObservation] = []
        self.prompts: list[str] = []

    def begin(self, prompt: str) -> None:
        self.prompts.append(prompt)

    def ask(self, seen: BenchmarkObservation) -> ActionChunk:
        self.asked.append(seen)
        assert seen.pose is not None
        assert seen.privileged is not None
        away_m = seen.privileged.values["mark"] - seen.pose.position_m
        steps = np.zeros((self.spec.action.horizon, 6), np.float32)
        for row in steps:
            row[:3] = np.clip(away_m, -LARGEST_M, LARGEST_M)
            away_m = away_m - row[:3]
        scale = self.spec.action.position_scale_m
        steps[:, :3] /= scale
        return ActionChunk("reacher", self.spec.hash, 1, 1, 1, 1, steps, 1, 1, 1)
