"""Checks a target of the arm before it moves, with the same bounds as for a chunk.

The command node's own kinematic model and barriers follow the path in small steps, until a limit
leaves nothing of a step.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import BoundedStep, LimitHit, into_workspace, workspace_corners
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.so3 import Pose, interpolate, pose_distance
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, HeldBox, JointBound

STEP_M, STEP_RAD = 0.01, 0.05
STEP_S = 1.0
"""Duration of a step: the arm is slowed down where its joints need more time."""
NEAR_M, NEAR_RAD = 5e-4, 1e-3
NEAR_JOINT = JointBound(NEAR_RAD, NEAR_M)
"""The target is reached: half the tolerance of a primitive."""
TRIES = 12
"""Before a barrier each step takes half of what is left."""


class TargetCheck:
    """Checks targets of a motion. Independent of time.

    Args:
        reach: of the arm; it is moved.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter) -> None:
        self._limits, self._reach = profile.limits, reach
        self.kinematics = reach.kinematics
        self.bounds = JointBounds(profile, reach.kinematics, reach.barriers)

    def hold(self, box: HeldBox | None) -> None:
        """Count what the gripper holds among the arm's links; None: nothing."""
        self._reach.hold(box)

    def pose_fault(self, joints_rad: FloatArray, target: Pose) -> str:
        """Why the TCP cannot go from joints (n,) straight to `target`; empty if it can."""
        here = self.kinematics.forward(joints_rad)
        if why := self._outside(target.position_m, here.position_m):
            return why
        self._reach.reset(joints_rad)
        count = _count(*pose_distance(here, target))
        at = here
        for number in range(1, count + 1):
            aim, hits = interpolate(here, target, number / count), []
            for _ in range(TRIES):
                at, hits, *_ = _last(self._reach.bound_in_pieces(at, aim, STEP_S))
                left_m, left_rad = pose_distance(at, aim)
                if left_m < NEAR_M and left_rad < NEAR_RAD:
                    break
            else:
                return _blocked(hits, at, target)
        return ""

    def joints_fault(self, joints_rad: FloatArray, target_rad: FloatArray) -> str:
        """The same of a straight motion of the joints to `target_rad` (n,), on the shortest way."""
        target_rad = self.kinematics.nearest(target_rad, joints_rad)
        lower_rad, upper_rad = self.bounds.lower_rad, self.bounds.upper_rad
        names, near = self.kinematics.arm_joints, NEAR_JOINT.of(self.kinematics.slides)
        for index, name in enumerate(names):
            low, high = float(lower_rad[index]), float(upper_rad[index])
            if not low - near[index] <= target_rad[index] <= high + near[index]:
                unit = self.kinematics.unit(index)
                return (
                    f"joint_limit: {name} at {target_rad[index]:.4g} {unit}, its range is "
                    f"{low:.4g} to {high:.4g} {unit}"
                )
        here_m = self.kinematics.forward(joints_rad).position_m
        if why := self._outside(self.kinematics.forward(target_rad).position_m, here_m):
            return why
        way_rad = target_rad - joints_rad
        count = _count(*self.bounds.ways(joints_rad, way_rad))
        at = joints_rad
        for number in range(1, count + 1):
            aim, hits = joints_rad + number / count * way_rad, []
            for _ in range(TRIES):
                step = _last(self.bounds.bound_in_pieces(at, aim))
                at, hits = step.joints_rad, step.hits
                if (np.abs(aim - at) < near).all():
                    break
            else:
                forward = self.kinematics.forward
                return _blocked(hits, forward(at), forward(target_rad))
        return ""

    def _outside(self, position_m: FloatArray, here_m: FloatArray) -> str:
        _, outside_m = into_workspace(self._limits, position_m, here_m)
        if outside_m <= 0:
            return ""
        low, high = (", ".join(f"{x:g}" for x in c) for c in workspace_corners(self._limits))
        at = ", ".join(f"{x:.4g}" for x in position_m)
        return (
            f"workspace: ({at}) m is {1e3 * outside_m:.1f} mm outside of the box from ({low}) to "
            f"({high}) m (limits.workspace; base frame)"
        )


def _last(pieces: Generator[None, None, BoundedStep]) -> BoundedStep:
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            return end.value


def _count(far_m: float, far_rad: float) -> int:
    return max(1, int(np.ceil(max(far_m / STEP_M, far_rad / STEP_RAD))))


def _blocked(hits: list[LimitHit], at: Pose, target: Pose) -> str:
    left_m, left_rad = pose_distance(at, target)
    why = "reach"
    if hits:
        why = f"{hits[0].name}{hits[0].at} ({hits[0].value:.4g}, limit {hits[0].limit:.4g})"
    return f"{why}, {1e3 * left_m:.1f} mm and {left_rad:.3f} rad before the target"
