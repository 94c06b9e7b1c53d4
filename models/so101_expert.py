# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = ["lerobot-env-so101==0.4.0"]
# ///
"""The expert of `lerobot-env-so101`: a reference policy that reads the simulation's true state."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec


class SO101Expert:
    """The pick-and-place controller, one step at a time."""

    spec = ModelSpec(
        name="so101_expert",
        observation=ObservationSpec(state=("privileged",), prompt=False),
        action=ActionSpec(
            horizon=1,
            dt_s=0.1,
            rotation="rotvec",
            position_scale_m=0.025,
            gripper="open_fraction",
        ),
    )

    def load(self) -> None:
        from lerobot_env_so101.scripted.pick_place import PickPlaceController

        self._controller: Any = PickPlaceController()

    def reset(self) -> None:
        self._controller.reset()

    def infer(self, observation: Observation) -> ActionSteps:
        assert observation.privileged is not None
        true = observation.privileged.values
        move = self._controller.act(true["grasp"], true["block"], true["goal"])
        return ActionSteps([[*move[:3], 0.0, 0.0, 0.0, np.clip(move[3], 0.0, 1.0)]])
