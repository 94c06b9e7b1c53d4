# /// script
# requires-python = ">=3.11"
# dependencies = ["metaworld==3.1.1", "packaging"]
# ///
"""Meta-World's 50 Sawyer tasks: with 50 goals each, drawn with seed 42, or as LeRobot has them.

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
from vla_zenoh_benchmarks.mujoco_env import MujocoEnvironment, delta_action, draw_plainly

from vla_zenoh.policy.options import whole_number, yes_no
from vla_zenoh.types import GripperState, PoseState, PrivilegedState

GOAL_SEED, GOALS, MAX_STEPS = 42, 50, 500
CAMERAS = {"front": "corner2", "wrist": "gripperPOV"}
UNIT_M, STEP_S, MAX_WIDTH_M = 0.01, 0.0125, 0.1
DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)
LEROBOT = "lerobot"
"""Suite by the protocol of ``lerobot-eval``: an episode is a seed, and corner2 hangs nearer."""
LEROBOT_CAMERA_M = (0.75, 0.075, 0.7)


class MetaWorld(MujocoEnvironment):
    """See the module.

    Args:
        size: width and height of the pictures.
        plain: ``yes``: no shadows and no smooth edges, which a processor draws five times as fast.
    """

    action = delta_action(UNIT_M, STEP_S)
    max_width_m = MAX_WIDTH_M
    packages = ("metaworld", "mujoco", "numpy", "gymnasium")
    suites = ("mt50", "mt10", LEROBOT)

    def __init__(self, size: str = "480", plain: str = "no") -> None:
        self._plain = yes_no("plain", plain)
        self.size = (whole_number("size", size, least=16),) * 2
        self.cameras = dict.fromkeys(CAMERAS, self.size)
        self._goals: dict[str, Any] = {}
        self._made = ("", False)
        self._type: type = np.float64
        self._seen = np.zeros(39)

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        names = MT10_V3 if suite == "mt10" else ALL_V3_ENVIRONMENTS
        count = 0 if suite == LEROBOT else GOALS
        return [
            BenchmarkTask(name, name.removesuffix("-v3").replace("-", " "), MAX_STEPS, count)
            for name in names
        ]

    def reset(self, suite: str, task: str, episode: int) -> None:
        if task not in self._goals:
            self._goals[task] = metaworld.MT1(task, seed=GOAL_SEED).train_tasks
        by_seed = suite == LEROBOT
        if (task, by_seed) != self._made:
            self.close()
            self._made, self._env = (task, by_seed), ALL_V3_ENVIRONMENTS[task]()
            self._type = np.float32 if by_seed else np.float64
            if self._plain:
                draw_plainly(self._env.model)
            if by_seed:
                self._env.model.camera(CAMERAS["front"]).pos[:] = LEROBOT_CAMERA_M
                self._env.set_task(self._goals[task][0])
                self._env._freeze_rand_vec = False
                self._env.seeded_rand_vec = True
        if by_seed:
            self._env.seed(episode)
        else:
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
        # Meta-World computes in the type of the numbers; LeRobot gives it a policy's own.
        raw = np.clip(action[[0, 1, 2, 6]], -1.0, 1.0).astype(self._type)
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
