"""Policy of the primitives: chunks that move to one target, or keep the arm where it is. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vla_zenoh.keys import PRIMITIVES
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.types import FloatArray

DT_S, HORIZON = 0.05, 20
"""A chunk lasts five periods of `CHUNK_HZ`, so the loss of one does not brake the arm."""
CHUNK_HZ = 5.0


@dataclass(frozen=True, eq=False)
class Target:
    """Where to go: at most one of these; none: the arm stays where it is.

    Args:
        pose: of the TCP in the base frame.
        joints_rad: (n,) in the order of the profile.
        width_m: of the gripper, while the arm stands.
    """

    pose: Pose | None = None
    joints_rad: FloatArray | None = None
    width_m: float | None = None


class TargetPolicy:
    """A `Policy` whose chunks move to `target`.

    Its spec changes with the kind of target: absolute poses or joints, or deltas of zero with a
    width. Without a width the gripper keeps what it holds.
    """

    example_prompts = ("",)

    def __init__(self, joints: tuple[str, ...]) -> None:
        still = ActionSpec(
            horizon=HORIZON, dt_s=DT_S, kind="delta", rotation="rotvec", gripper="none"
        )
        seen = ObservationSpec(cameras=(), state=("pose",), prompt=False)
        self._still = ModelSpec(name=PRIMITIVES, observation=seen, action=still)
        self._width = self._with(gripper="absolute_m")
        self._pose = self._with(kind="absolute", rotation="quaternion")
        self._joints = self._with(kind="absolute", space="joint", joints=joints, rotation="rpy")
        self.spec, self.target = self._still, Target()

    def _with(self, **changes: object) -> ModelSpec:
        fields = {**self._still.action.model_dump(), **changes}
        return self._still.model_copy(update={"action": ActionSpec(**fields)})

    def infer(self, observation: Observation) -> ActionSteps:
        """The same step for the length of a chunk; `spec` defines its meaning."""
        target, step = self.target, [0.0] * 6
        spec = self._still
        if target.pose is not None:
            pose = target.pose
            spec = self._pose
            step = [*pose.position_m, *quat_from_rotation(pose.rotation)]
        elif target.joints_rad is not None:
            spec, step = self._joints, [*target.joints_rad]
        elif target.width_m is not None:
            spec, step = self._width, [*step, target.width_m]
        self.spec = spec
        return ActionSteps(np.tile(np.asarray(step, np.float64), (HORIZON, 1)))
