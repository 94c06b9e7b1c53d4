# /// script
# requires-python = ">=3.11"
# dependencies = ["ogbench==1.2.2"]
# ///
"""OGBench's cube oracle: a reference policy that reads the simulation's true state."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec

YAW_UNIT_RAD = 0.3
ARM_BOUNDS_M = ((0.25, -0.35, 0.20), (0.6, 0.35, 0.35))
"""Where the arm goes once the cube is there, which no longer matters."""


class OGBenchExpert:
    """The Markov oracle of the cube tasks."""

    spec = ModelSpec(
        name="ogbench_expert",
        observation=ObservationSpec(state=("privileged",), prompt=False),
        action=ActionSpec(
            horizon=1,
            dt_s=0.05,
            rotation="rotvec",
            position_scale_m=0.05,
            gripper="binary",
            gripper_open_is_high=False,
            gripper_threshold=0.0,
        ),
    )

    def load(self) -> None:
        from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle

        arm = SimpleNamespace(unwrapped=SimpleNamespace(_arm_sampling_bounds=ARM_BOUNDS_M))
        self._oracle: Any = CubeMarkovOracle(env=arm, min_norm=0.4)
        self._oracle.reset(None, None)

    def reset(self) -> None:
        self._oracle.reset(None, None)

    def infer(self, observation: Observation) -> ActionSteps:
        assert observation.privileged is not None
        seen: dict[str, Any] = dict(observation.privileged.values)
        seen["privileged/target_block"] = int(seen["privileged/target_block"][0])
        move = np.clip(self._oracle.select_action(None, seen), -1.0, 1.0)
        return ActionSteps([[*move[:3], 0.0, 0.0, move[3] * YAW_UNIT_RAD, move[4]]])
