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

import numpy as np
from lerobot_env_so101 import SO101PickPlaceGymEnv
from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask
from vla_zenoh_benchmarks.mujoco_env import MujocoEnvironment, quat_xyzw

from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import GripperState, JointState, PoseState, PrivilegedState

MAX_STEPS, STEP_S, MAX_WIDTH_M = 300, 0.1, 0.1
ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class SO101(MujocoEnvironment):
    action = ActionSpec(
        horizon=1,
        dt_s=STEP_S,
        rotation="rotvec",
        position_scale_m=DEFAULT_ACTION_SCALE,
        gripper="open_fraction",
    )
    cameras = {"front": MujocoEnvironment.size}
    packages = ("lerobot-env-so101", "mujoco", "numpy", "gymnasium")
    suites = ("pick-place",)

    def __init__(self) -> None:
        self._env = SO101PickPlaceGymEnv(
            random_block_position=True, action_scale=DEFAULT_ACTION_SCALE
        )

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        return [BenchmarkTask("pick-place", "put the cube on its goal", MAX_STEPS)]

    def reset(self, suite: str, task: str, episode: int) -> None:
        self._env.reset(seed=episode)

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        env, data = self._env, self._env.data
        joints = [data.joint(name) for name in ARM]
        site = data.site("gripperframe")
        low, high = env.model.joint("gripper").range
        opening = float(np.clip((data.joint("gripper").qpos[0] - low) / (high - low), 0.0, 1.0))
        return BenchmarkObservation(
            images={name: self.draw(name) for name in cameras},
            joint=JointState(
                ARM,
                np.concatenate([each.qpos for each in joints]),
                np.concatenate([each.qvel for each in joints]),
                None,
            ),
            pose=PoseState(env.ik_point_pos, quat_xyzw(site.xmat), np.zeros(6)),
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
