"""Always the same action of Meta-World: the rows of zero and of the mean action beside a policy."""

from __future__ import annotations

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.options import number

COUNT = 4


class Constant:
    """See the module.

    Args:
        action: x, y, z and the force of the fingers, joined by commas, each from -1 to 1.
    """

    def __init__(self, action: str = "0,0,0,0") -> None:
        given = [number("action", each, least=-1.0) for each in action.split(",")]
        if len(given) != COUNT:
            raise SpecError(f"action is {action!r}; wanted x,y,z,gripper")
        self._step = [*given[:3], 0.0, 0.0, 0.0, given[3]]
        self.spec = ModelSpec(
            name="constant",
            observation=ObservationSpec(state=("pose",)),
            action=ActionSpec(
                horizon=1,
                dt_s=0.0125,
                rotation="rotvec",
                position_scale_m=0.01,
                gripper="binary",
                gripper_open_is_high=False,
                gripper_threshold=0.0,
            ),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        return ActionSteps([self._step])
