# /// script
# requires-python = ">=3.11"
# dependencies = ["metaworld==3.1.1", "packaging"]
# ///
"""Meta-World's 50 Sawyer tasks, each with 50 goals drawn with seed 42.

An action is a displacement of the point that the hand is pulled to, 0.01 m to the unit, and the
force of the fingers, 1 closes. The hand does not turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import metaworld
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, MT10_V3
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask
from vla_zenoh_benchmarks.mujoco_env import MujocoEnvironment, delta_action

from vla_zenoh.types import GripperState, PoseState, PrivilegedState

GOAL_SEED, GOALS, MAX_STEPS = 42, 50, 500
CAMERAS = {"front": "corner2", "wrist": "gripperPOV"}
UNIT_M, STEP_S, MAX_WIDTH_M = 0.01, 0.0125, 0.1
DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)


class MetaWorld(MujocoEnvironment):
    action = delta_action(UNIT_M, STEP_S)
    size = (480, 480)
    cameras = dict.fromkeys(CAMERAS, size)
    max_width_m = MAX_WIDTH_M
    packages = ("metaworld", "mujoco", "numpy", "gymnasium")
    suites = ("mt50", "mt10")

    def __init__(self) -> None:
        self._goals: dict[str, Any] = {}
        self._task = ""
        self._seen = np.zeros(39)

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        names = {"mt50": ALL_V3_ENVIRONMENTS, "mt10": MT10_V3}[suite]
        return [
            BenchmarkTask(name, name.removesuffix("-v3").replace("-", " "), MAX_STEPS, GOALS)
            for name in names
        ]

    def reset(self, suite: str, task: str, episode: int) -> None:
        if task not in self._goals:
            self._goals[task] = metaworld.MT1(task, seed=GOAL_SEED).train_tasks
        if task != self._task:
            self.close()
            self._task, self._env = task, ALL_V3_ENVIRONMENTS[task]()
        self._env.set_task(self._goals[task][episode])
        self._seen, _ = self._env.reset()

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        data = self._env.data
        return BenchmarkObservation(
            images={name: self._draw(name) for name in cameras},
            pose=PoseState(
                data.body("hand").xpos,
                DOWN_XYZW,
                np.zeros(6),
                reference_position_m=data.mocap_pos[0],
                reference_quat_xyzw=DOWN_XYZW,
            ),
            gripper=GripperState(float(self._seen[3]) * MAX_WIDTH_M, moving=False, holding=False),
            privileged=PrivilegedState({"observation": self._seen}),
        )

    def step(self, action: NDArray[np.float64]) -> bool:
        raw = np.clip(action[[0, 1, 2, 6]], -1.0, 1.0)
        self._seen, _, _, _, info = self._env.step(raw)
        return bool(info["success"] > 0)

    @property
    def limits(self) -> dict[str, object]:
        """Of the command node: the task's own box for the pulled point, and the arm's fastest."""
        low_m, high_m = self._env.mocap_low, self._env.mocap_high
        box = {f"{axis}_m": [float(low_m[i]), float(high_m[i])] for i, axis in enumerate("xyz")}
        return {
            "workspace": box,
            "translation": {
                "velocity_m_s": 1.4,
                "acceleration_m_s2": 13.0,
                "jerk_m_s3": 4000.0,
            },
            "tracking_m": 0.2,  # the hand hangs on its point by a soft spring
        }

    def set_point(self, position_m: NDArray[np.float64], width_m: float) -> NDArray[np.float64]:
        """The step that brings the pulled point to `position_m`, as far as one step can."""
        towards = (position_m - self._env.data.mocap_pos[0]) / UNIT_M
        return np.array([*np.clip(towards, -1, 1), 0, 0, 0, 1 - 2 * (width_m > MAX_WIDTH_M / 2)])

    def _draw(self, camera: str) -> NDArray[np.uint8]:
        picture = self.draw(CAMERAS[camera])
        return picture[::-1, ::-1] if camera == "front" else picture  # corner2 hangs upside down
