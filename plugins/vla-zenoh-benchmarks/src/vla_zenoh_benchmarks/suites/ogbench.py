# /// script
# requires-python = ">=3.11"
# dependencies = ["ogbench==1.2.2"]
# ///
"""OGBench's cubes with a UR5e: bring the shown cube to its target, as its data was collected.

The index of an episode is its seed. An action is added to the measured pose: 0.05 m and 0.3 rad to
the unit; the gripper closes above 0. Its goal-conditioned protocol is not covered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import ogbench.manipspace  # noqa: F401 # registers its environments
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask
from vla_zenoh_benchmarks.mujoco_env import MujocoEnvironment, delta_action, quat_xyzw

from vla_zenoh.types import GripperState, JointState, PoseState, PrivilegedState

MAX_STEPS = {"cube-single-v0": 200, "cube-double-v0": 500, "cube-triple-v0": 1000}
UNIT_M, UNIT_RAD, STEP_S, MAX_WIDTH_M = 0.05, 0.3, 0.05, 0.085


class OGBench(MujocoEnvironment):
    action = delta_action(UNIT_M, STEP_S)
    cameras = {"front": MujocoEnvironment.size}
    packages = ("ogbench", "mujoco", "numpy", "gymnasium")
    suites = ("cube",)

    def __init__(self) -> None:
        self._name = ""
        self._info: dict[str, Any] = {}

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        prompt = "put the cube on its target"
        return [BenchmarkTask(name, prompt, steps) for name, steps in MAX_STEPS.items()]

    def reset(self, suite: str, task: str, episode: int) -> None:
        if task != self._name:
            self.close()
            made = gymnasium.make(task, terminate_at_goal=False, mode="data_collection")
            self._name, self._env = task, made.unwrapped
        _, self._info = self._env.reset(seed=episode)

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        seen = self._info
        data, site = self._env.data, self._env._pinch_site_id
        joints = seen["proprio/joint_pos"]
        return BenchmarkObservation(
            images={name: self.draw(name) for name in cameras},
            joint=JointState(
                tuple(f"joint{i}" for i in range(1, len(joints) + 1)),
                joints,
                seen["proprio/joint_vel"],
                None,
            ),
            pose=PoseState(data.site_xpos[site], quat_xyzw(data.site_xmat[site]), np.zeros(6)),
            gripper=GripperState(
                MAX_WIDTH_M * (1 - float(seen["proprio/gripper_opening"][0])),
                moving=False,
                holding=bool(seen["proprio/gripper_contact"][0] > 0.5),
            ),
            privileged=PrivilegedState(
                {name: np.atleast_1d(v) for name, v in seen.items() if _numeric(v)}
            ),
        )

    def step(self, action: NDArray[np.float64]) -> bool:
        raw = [*action[:3], action[5] / UNIT_RAD, action[6]]
        _, _, _, _, self._info = self._env.step(np.clip(raw, -1.0, 1.0))
        return bool(self._info["success"])


def _numeric(value: Any) -> bool:
    array = np.asarray(value)
    return array.dtype.kind in "iuf" and array.ndim <= 1
