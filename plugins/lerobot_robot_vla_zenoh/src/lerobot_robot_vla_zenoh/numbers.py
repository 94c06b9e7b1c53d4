"""An arm in LeRobot's numbers: ``JOINT.pos`` in degrees, ``gripper.pos`` 0 shut to 100 open.

An arm without a gripper has no ``gripper.pos``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray
from vla_zenoh_policy_servers.action_semantics import read_action_semantics
from vla_zenoh_policy_servers.presets import LEROBOT, LEROBOT_STATE
from vla_zenoh_policy_servers.state_vector import read_parts, state_numbers

from vla_zenoh import RemoteRobot
from vla_zenoh.errors import ProfileError, VlaZenohError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.policy import Observation
from vla_zenoh.policy.meaning import joints_as
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, Task


class ArmNumbers:
    """Converts an arm's states to LeRobot's numbers, and LeRobot's actions to steps.

    Args:
        profile: of the arm.
        fps: of LeRobot's loop.

    Attributes:
        names: of the numbers, in order.
        action: what a step of `step` means.

    Raises:
        ProfileError: a joint of it slides, for which LeRobot has no unit.
    """

    def __init__(self, profile: Profile, fps: int) -> None:
        joints = profile.robot.arm_joints
        grips = profile.robot.gripper is not None
        units = {name: unit for name, unit in LEROBOT.items() if grips or "grip" not in name}
        options = {"gripper": "none", **units, "dt_s": repr(1 / fps), "horizon": "1"}
        self._semantics = read_action_semantics(options, joints=joints)
        parts = read_parts(LEROBOT_STATE if grips else "joint")
        self._state = state_numbers(parts, profile, self._semantics.state_units)
        self.action = self._semantics.spec
        self.names = [f"{name}.pos" for name in joints] + ["gripper.pos"] * grips
        kinematics = make_kinematics(profile)
        order = [kinematics.arm_joints.index(name) for name in joints]
        if sliding := [
            name for name, at in zip(joints, order, strict=True) if kinematics.slides[at]
        ]:
            raise ProfileError(f"{', '.join(sliding)} slides, and LeRobot's joints are in degrees")
        margin_rad = profile.limits.reach.joint_margin_rad
        lower_rad, upper_rad = kinematics.lower_rad[order], kinematics.upper_rad[order]
        ends = np.array([[*(lower_rad + margin_rad), 0.0], [*(upper_rad - margin_rad), 1.0]])
        self._lowest, self._highest = self._semantics.rows(ends[:, : len(self.names)])

    def features(self) -> dict[str, type]:
        """Name -> type of each number."""
        return dict.fromkeys(self.names, float)

    def measured(self, robot: RemoteRobot) -> dict[str, float]:
        """Name -> number of the newest state.

        Raises:
            DeviceNotConnectedError: there is none that is not too old.
        """
        try:
            joint, gripper = robot.joint_state(), robot.gripper_state()
        except VlaZenohError as error:
            raise DeviceNotConnectedError(str(error)) from error
        seen = Observation(
            *(joint.header.stamp_wall_ns, joint.header.seq, Task(0, False, "", "", 1.0)),
            joint=joints_as(joint.record, self.action.turns),
            gripper=gripper.record,
        )
        return dict(zip(self.names, self._state.encode(seen).tolist(), strict=True))

    def within_range(self, action: Mapping[str, float]) -> dict[str, float]:
        """An action whose numbers are within the range of each joint.

        Raises:
            ValueError: a number is missing, unknown or not finite; names it.
        """
        if lacking := [name for name in self.names if name not in action]:
            raise ValueError(
                f"the action lacks {', '.join(lacking)}; it has {', '.join(action) or 'nothing'}"
            )
        if strange := sorted(action.keys() - set(self.names)):
            raise ValueError(f"the arm has no {', '.join(strange)}; it has {', '.join(self.names)}")
        row = np.array([float(action[name]) for name in self.names])
        if not np.isfinite(row).all():
            wrong = self.names[int(np.argmin(np.isfinite(row)))]
            raise ValueError(f"{wrong} is {action[wrong]}, wanted a finite number")
        row = row.clip(self._lowest, self._highest)
        return dict(zip(self.names, row.tolist(), strict=True))

    def step(self, action: Mapping[str, float]) -> FloatArray:
        """(n,) step of a chunk for an action of `within_range`."""
        row = np.array([[action[name] for name in self.names]])
        steps: NDArray[np.float64] = self._semantics.steps(row)
        return steps[0]
