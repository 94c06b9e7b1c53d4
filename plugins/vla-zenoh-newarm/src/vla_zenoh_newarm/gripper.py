"""What the joints of a hand mean as a gripper, by their ranges and by where their fingers end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from vla_zenoh.kinematics.collision import collision_shapes
from vla_zenoh.kinematics.description import DescribedJoint, Description
from vla_zenoh.types import FloatArray

MOST_FINGERS = 3
"""More joints that move by themselves are a hand, and no gripper."""
AT_SHUT = 0.1
"""A sliding finger that begins within this share of its range from 0 is shut at 0."""
WIDTHS_M = (0.02, 0.3)
"""A gripper opens by something between these."""


class Gripper(NamedTuple):
    """A gripper as a profile has it.

    Args:
        joints: its finger joints.
        values: of section `gripper`.
        why: about the joints of a hand that is left still; empty: there is none.
    """

    joints: tuple[str, ...] = ()
    values: Mapping[str, float] = {}
    why: str = ""


def gripper(described: Description, fingers: Sequence[str]) -> Gripper:
    """The gripper of these joints, which move by themselves.

    Raises:
        ResourceError: the shapes of the description cannot be loaded.
    """
    if not fingers:
        return Gripper()
    joints = [described.joints[name] for name in fingers]
    if len(joints) > MOST_FINGERS or len({joint.kind for joint in joints}) > 1:
        names = ", ".join(fingers)
        return Gripper(why=f"a hand of several joints is no gripper; left still: {names}")
    if joints[0].kind == "prismatic":
        together = [described.joints[name] for name in described.led_by(fingers)]
        together = [joint for joint in together if joint.kind == "prismatic"]
        if all(map(_shut_at_zero, together)):
            width_m = sum(max(abs(joint.lower), abs(joint.upper)) for joint in together)
            names = tuple(joint.name for joint in together)
            return Gripper(names, {"max_width_m": round(width_m, 4)})
    return _by_ends(described, joints)


def _shut_at_zero(joint: DescribedJoint) -> bool:
    ends = sorted((abs(joint.lower), abs(joint.upper)))
    return ends[0] <= AT_SHUT * (joint.upper - joint.lower) < ends[1]


def _by_ends(described: Description, joints: Sequence[DescribedJoint]) -> Gripper:
    """A gripper whose first joint is open at one end of its range; the others go with it."""
    first = joints[0]
    names = tuple(joint.name for joint in joints if _moves_like(first, joint))
    tips = _Tips(described, names)
    lower, upper = tips.apart_m(first.lower), tips.apart_m(first.upper)
    opened, shut = (first.upper, first.lower) if upper >= lower else (first.lower, first.upper)
    low_m, high_m = WIDTHS_M
    width_m = min(max(tips.width_m(opened, shut), low_m), high_m)
    values = {
        "max_width_m": round(width_m, 3),
        f"joint_open_{first.unit}": round(opened, 4),
        f"joint_shut_{first.unit}": round(shut, 4),
    }
    others = [joint.name for joint in joints if joint.name not in names]
    why = f"joints of the hand that are left still: {', '.join(others)}" if others else ""
    return Gripper(names, values, why)


def _moves_like(first: DescribedJoint, joint: DescribedJoint) -> bool:
    """Whether its range is that of the first, or its mirror image."""
    ends, span = (first.lower, first.upper), first.upper - first.lower
    return any(
        np.allclose(ends, other, atol=AT_SHUT * span)
        for other in ((joint.lower, joint.upper), (-joint.upper, -joint.lower))
    )


class _Tips:
    """Where the fingers end: the point of each that is furthest from the joint it turns about."""

    def __init__(self, described: Description, joints: Sequence[str]) -> None:
        self._described, self._joints = described, joints
        self._model: Any = pin.buildModelFromXML(described.text({}))
        self._data: Any = self._model.createData()
        moving = {self._id(name) for name in described.led_by(joints)}
        points: dict[int, list[FloatArray]] = {}
        for shape in collision_shapes(self._model, described.path).geometryObjects:
            if shape.parentJoint in moving:
                middle = shape.placement * np.array(_middle(shape))
                points.setdefault(shape.parentJoint, []).append(middle)
        self._tips = {
            joint: max(found, key=lambda point: float(np.linalg.norm(point)))
            for joint, found in points.items()
        }

    def apart_m(self, position: float) -> float:
        """How far the two furthest tips are from each other; of a single one how far it turned.

        Args:
            position: of the first joint, m or rad.
        """
        configuration = pin.neutral(self._model)
        for name in self._described.led_by(self._joints):
            leader, multiplier, offset = self._described.follows(name)
            at = position if leader in self._joints else 0.0
            index = self._model.joints[self._id(name)].idx_q
            if self._model.joints[self._id(name)].nq == 1:
                configuration[index] = multiplier * at + offset
        pin.forwardKinematics(self._model, self._data, configuration)
        tips = [self._data.oMi[joint] * tip for joint, tip in self._tips.items()]
        if len(tips) < 2:
            return abs(position)
        return max(float(np.linalg.norm(a - b)) for a in tips for b in tips)

    def width_m(self, opened: float, shut: float) -> float:
        """Opening between two positions of the first joint."""
        if len(self._tips) > 1:
            return self.apart_m(opened) - self.apart_m(shut)
        length_m = max((float(np.linalg.norm(tip)) for tip in self._tips.values()), default=0.0)
        return abs(opened - shut) * length_m

    def _id(self, name: str) -> int:
        return self._model.getJointId(self._described.model_name(name))


def _middle(shape: Any) -> FloatArray:
    geometry = shape.geometry
    geometry.computeLocalAABB()
    return np.array(geometry.aabb_center)
