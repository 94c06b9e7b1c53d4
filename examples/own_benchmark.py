"""A custom benchmark: a hand over a table has to reach a mark. No packages, no images.

    vla-zenoh bench sim examples/own_benchmark.py --worker MODEL

Its three tasks differ in how far the mark may be; an episode's index is the seed of hand and mark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask

from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import GripperState, PoseState, PrivilegedState

STEP_S, LARGEST_M, REACHED_M, HEIGHT_M = 0.05, 0.02, 0.01, 0.3
REACH_M = {"near": 0.05, "middle": 0.15, "far": 0.25}
CENTRE_M = np.array([0.45, 0.0, HEIGHT_M])
DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)


class ReachTheMark:
    action = ActionSpec(horizon=1, dt_s=STEP_S, rotation="rotvec", gripper="none")
    cameras: Mapping[str, tuple[int, int]] = MappingProxyType({})
    suites = ("reach",)
    packages = ("numpy",)

    def __init__(self) -> None:
        self._hand_m = self._mark_m = CENTRE_M

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        return [BenchmarkTask(name, f"reach the {name} mark", max_steps=60) for name in REACH_M]

    def reset(self, suite: str, task: str, episode: int) -> None:
        rng = np.random.default_rng(episode)
        self._hand_m = CENTRE_M.copy()
        self._mark_m = CENTRE_M + [*rng.uniform(-REACH_M[task], REACH_M[task], 2), 0.0]

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        return BenchmarkObservation(
            pose=PoseState(self._hand_m, DOWN_XYZW, np.zeros(6)),
            gripper=GripperState(0.08, moving=False, holding=False),
            privileged=PrivilegedState({"mark": self._mark_m}),
        )

    def step(self, action: NDArray[np.float64]) -> bool:
        self._hand_m = self._hand_m + np.clip(action[:3], -LARGEST_M, LARGEST_M)
        return bool(np.linalg.norm(self._hand_m - self._mark_m) < REACHED_M)

    def physics(self) -> NDArray[np.float64]:
        return np.concatenate([self._hand_m, self._mark_m])

    def set_point(self, position_m: NDArray[np.float64], width_m: float) -> NDArray[np.float64]:
        """The step towards a commanded position, for --mode command."""
        return np.array([*(position_m - self._hand_m), 0.0, 0.0, 0.0])
