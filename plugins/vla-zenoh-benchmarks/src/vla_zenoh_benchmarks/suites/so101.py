# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = ["lerobot-env-so101==0.4.0"]
# ///
"""An SO-101 that carries a cube to a place on the table, of `lerobot-env-so101`.

The index of an episode is its seed, which places cube and goal. An action is added to the point
that the grasp is pulled to, 0.025 m to the unit, as the package's own expert has it; the hand
points down and does not turn. Success: carried, released and at rest within 0.03 m. The package's
pick task is left out: its own expert cannot do it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from lerobot_env_so101 import SO101PickPlaceGymEnv
from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask

from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import GripperState, JointState, PoseState, PrivilegedState

MAX_STEPS, STEP_S, MAX_WIDTH_M = 300, 0.1, 0.1
PICTURE = (640, 480)
ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class SO101:
    action = ActionSpec(
        horizon=1,
        dt_s=STEP_S,
        rotation="rotvec",
        position_scale_m=DEFAULT_ACTION_SCALE,
        gripper="open_fraction",
    )
    cameras = {"front": PICTURE}
    packages = ("lerobot-env-so101", "mujoco", "numpy", "gymnasium")
    suites = ("pick-place",)

    def __init__(self) -> None:
        self._env = SO101PickPlaceGymEnv(
            random_block_position=True, action_scale=DEFAULT_ACTION_SCALE
        )
        self._renderer: Any = None

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        return [BenchmarkTask("pick-place", "put the cube on its goal", MAX_STEPS)]

    def reset(self, suite: str, task: str, episode: int) -> None:
        self._env.reset(seed=episode)

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        env, data = self._env, self._env.data
        joints = [data.joint(name) for name in ARM]
        site = data.site("gripperframe")
        quat_wxyz = np.zeros(4)
        mujoco.mju_mat2Quat(quat_wxyz, site.xmat)
        low, high = env.model.joint("gripper").range
        opening = float(np.clip((data.joint("gripper").qpos[0] - low) / (high - low), 0.0, 1.0))
        return BenchmarkObservation(
            images={name: self._draw(name) for name in cameras},
            joint=JointState(
                ARM,
                np.concatenate([each.qpos for each in joints]),
                np.concatenate([each.qvel for each in joints]),
                None,
            ),
            pose=PoseState(env.ik_point_pos, np.roll(quat_wxyz, -1), np.zeros(6)),
            gripper=GripperState(MAX_WIDTH_M * opening, moving=False, holding=False),
            privileged=PrivilegedState(
                {
                    "grasp": env.ik_point_pos,
                    "block": data.sensor("block_pos").data,
                    "goal": env.goal_pos,
                }
            ),
        )

    def step(self, action: NDArray[np.float64]) -> bool:
        raw = np.float32(action[[0, 1, 2, 6]])  # as its action space
        _, _, _, _, info = self._env.step(np.clip(raw, [-1, -1, -1, 0], 1).astype(np.float32))
        return bool(info["succeed"])

    def physics(self) -> NDArray[np.float64]:
        return np.concatenate([self._env.data.qpos, self._env.data.qvel])

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None

    def _draw(self, camera: str) -> NDArray[np.uint8]:
        if self._renderer is None:
            model = self._env.model
            model.vis.global_.offwidth, model.vis.global_.offheight = PICTURE
            self._renderer = mujoco.Renderer(model, PICTURE[1], PICTURE[0])
        self._renderer.update_scene(self._env.data, camera)
        return self._renderer.render()
