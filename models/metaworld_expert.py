# /// script
# requires-python = ">=3.11"
# dependencies = ["metaworld==3.1.1", "packaging"]
# ///
"""Meta-World's scripted experts: a reference policy that reads the simulation's true state."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec


class MetaWorldExpert:
    """The expert of the task that the prompt names: ``pick place`` is ``pick-place-v3``.

    Args:
        repeat: steps of a chunk, all of them as the expert decided for the first: 4 is a policy
            of 20 Hz.
    """

    def __init__(self, repeat: str = "1") -> None:
        self._expert: tuple[str, Any] = ("", None)
        self.spec = ModelSpec(
            name="metaworld_expert",
            observation=ObservationSpec(state=("privileged",)),
            action=ActionSpec(
                horizon=int(repeat),
                dt_s=0.0125,
                rotation="rotvec",
                position_scale_m=0.01,
                gripper="binary",
                gripper_open_is_high=False,
                gripper_threshold=0.0,
            ),
        )

    def load(self) -> None:
        from metaworld.policies import ENV_POLICY_MAP

        warnings.filterwarnings("ignore", message="Constant")  # logged at most steps
        self._known = ENV_POLICY_MAP

    def infer(self, observation: Observation) -> ActionSteps:
        name = observation.prompt.replace(" ", "-") + "-v3"
        if self._expert[0] != name:
            if name not in self._known:
                raise WorkerError(f"Meta-World has no expert for {observation.prompt!r}")
            self._expert = (name, self._known[name]())
        assert observation.privileged is not None
        seen = observation.privileged.values["observation"].copy()  # some write into it
        move = np.clip(self._expert[1].get_action(seen), -1.0, 1.0)
        return ActionSteps([[*move[:3], 0.0, 0.0, 0.0, move[3]]] * self.spec.action.horizon)
