"""Joints of physicalai, in their order and unit, as ours: one meaning, in both directions."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray

Unit = Literal["degrees", "radians", "normalised"]
UNIT_OF: Mapping[str, Unit] = {
    "physicalai.robot.SO101": "normalised",
    "physicalai.robot.WidowXAI": "degrees",
    "vla_zenoh.degrees": "degrees",
    "vla_zenoh.radians": "radians",
    "vla_zenoh.normalised": "normalised",
}
"""``robot_class`` of the metadata -> unit of its joints."""


class Layout:
    """A joint vector of theirs, as joints of the arm and width of the gripper.

    Args:
        profile: of the arm.
        names: of the joints of theirs, in their order.
        unit: of their joints; ``normalised``: -100 to 100 from one end of the arm's joint to the
            other.
        joints: theirs of each of ``robot.arm_joints``.
        reversed: arm_joints that turn against the description.
        zero: their number where each joint of the description is 0; empty: 0.
        gripper: its joint; empty: there is none.
        gripper_ends: its number when shut and when open.

    Raises:
        NodeError: their joints are not exactly those of the arm and its gripper; names them.
    """

    def __init__(
        self,
        profile: Profile,
        names: Sequence[str],
        unit: Unit,
        *,
        joints: Sequence[str],
        reversed: Sequence[str] = (),
        zero: Sequence[float] = (),
        gripper: str = "",
        gripper_ends: tuple[float, float] = (0.0, 100.0),
    ) -> None:
        wanted = [*joints, *([gripper] if gripper else [])]
        absent, unused = set(wanted) - {*names}, set(names) - {*wanted}
        if absent or unused:
            raise NodeError(
                f"its joints are {', '.join(names)}; missing: {', '.join(sorted(absent)) or 'none'}"
                f", not of this arm: {', '.join(sorted(unused)) or 'none'}. Set joints (theirs of "
                "each of robot.arm_joints) and gripper"
            )
        self.count = len(names)
        self._at = [names.index(name) for name in joints]
        self._gripper_at = names.index(gripper) if gripper else None
        self._ends = gripper_ends
        self._width_m = profile.robot.max_width_m
        ours = profile.robot.arm_joints
        sign = np.array([-1.0 if name in reversed else 1.0 for name in ours])
        self._zero = np.array(zero or (0.0,) * len(ours))
        kinematics = make_kinematics(profile)
        order = [kinematics.arm_joints.index(name) for name in ours]
        slides = list(itertools.compress(ours, kinematics.slides[order]))
        if slides and unit == "degrees":
            raise NodeError(f"unit degrees, but {', '.join(slides)} slides: declare normalised")
        if unit == "normalised":
            lower_rad, upper_rad = kinematics.lower_rad[order], kinematics.upper_rad[order]
            endless = list(itertools.compress(ours, kinematics.endless[order]))
            if len(zero):
                raise NodeError("zero is given, but normalised joints have theirs by their ends")
            if endless:
                raise NodeError(f"unit normalised, but {', '.join(endless)} turns without end")
            self._unit_rad = sign * (upper_rad - lower_rad) / 200
            self._zero = -(upper_rad + lower_rad) / 2 / self._unit_rad
        else:
            self._unit_rad = sign * (np.pi / 180 if unit == "degrees" else 1.0)

    def ours(self, vector: FloatArray) -> tuple[FloatArray, float | None]:
        """Positions in rad in the order of ``robot.arm_joints``, and the gripper's width in m."""
        position_rad = (vector[self._at] - self._zero) * self._unit_rad
        if self._gripper_at is None:
            return position_rad, None
        shut, opened = self._ends
        share = (vector[self._gripper_at] - shut) / (opened - shut)
        return position_rad, float(np.clip(share, 0.0, 1.0)) * self._width_m

    def theirs(self, position_rad: FloatArray, width_m: float | None) -> FloatArray:
        """The inverse of `ours`; a width is not used where there is no gripper."""
        vector = np.empty(self.count)
        vector[self._at] = position_rad / self._unit_rad + self._zero
        if self._gripper_at is not None:
            assert width_m is not None
            shut, opened = self._ends
            share = min(max(width_m / self._width_m, 0.0), 1.0)
            vector[self._gripper_at] = shut + share * (opened - shut)
        return vector
