"""Targets of Inspect Robots' actions: joints and gripper, and why the arm cannot go to one.

No Zenoh, no clock, nothing of Inspect Robots.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_primitives.target_check import TargetCheck

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointBound

GRIPPER = "gripper"
SETTLED = JointBound(0.01, 0.003)
"""Joints this near to home are there."""
SHARE = 0.8
"""Of each joint's speed that one step may ask for: its motion is smoothed, too."""


class Targets:
    """What the actions of an arm mean: (n,) absolute joints and, of one that has it, the gripper.

    Args:
        profile: of the arm.
        rate_hz: of the actions.

    Attributes:
        labels: of the numbers: joints in the order of the profile, and the gripper.
        low, high: (n,) rad, of a joint that slides m; 0 (shut) to 1. A joint that turns without
            an end is between -pi and pi, and goes the shortest way.
        most: (n,) change of one step that the arm can follow.
    """

    def __init__(self, profile: Profile, rate_hz: float) -> None:
        profile.require_one_arm("inspect-robots")
        self._check = TargetCheck(profile, ReachabilityFilter(profile))
        names = profile.robot.arm_joints
        kinematics, bounds = self._check.kinematics, self._check.bounds
        self._order = [kinematics.arm_joints.index(name) for name in names]
        self._back = np.argsort(self._order)
        grips = profile.robot.gripper is not None
        self.labels = (*names, *[GRIPPER] * grips)
        self._settled = SETTLED.of(kinematics.slides[self._order])
        self._endless = np.array([*kinematics.endless[self._order], *[False] * grips])
        ends = bounds.lower_rad[self._order], bounds.upper_rad[self._order]
        self.low = np.where(self._endless, -np.pi, [*ends[0], *[0.0] * grips])
        self.high = np.where(self._endless, np.pi, [*ends[1], *[1.0] * grips])
        given = np.asarray(profile.limits.joint.velocity_rad_s, float)
        speed_rad_s = np.broadcast_to(given, (len(names),))
        self.most = np.array([*(SHARE * speed_rad_s / rate_hz), *[1.0] * grips])
        self.action = ActionSpec(
            horizon=1,
            dt_s=1 / rate_hz,
            kind="absolute",
            space="joint",
            joints=names,
            gripper="open_fraction" if grips else "none",
        )

    def refusal(self, here: FloatArray, target: FloatArray) -> str:
        """Why the arm cannot go straight from `here` to `target`, (n,); empty if it can."""
        if not np.isfinite(target).all():
            wrong = self.labels[int(np.argmin(np.isfinite(target)))]
            return f"{wrong} is {target[self.labels.index(wrong)]}, wanted a finite number"
        return self._check.joints_fault(here[self._back], target[self._back])

    def refusal_of_path(self, here: FloatArray, path: NDArray[np.float64]) -> str:
        """The same of a path (k, n) from `here`; names the waypoint."""
        at = here
        for number, target in enumerate(np.asarray(path, float), 1):
            if why := self.refusal(at, target):
                return f"waypoint {number} of {len(path)}: {why}"
            at = target
        return ""

    def way(self, here: FloatArray, target: FloatArray) -> NDArray[np.float64]:
        """(k, n) steps straight to `target` that the arm can follow."""
        way = self.apart(here, target)
        count = max(1, int(np.ceil(np.max(np.abs(way) / self.most))))
        shares = np.arange(1, count + 1)[:, None] / count
        return here + shares * way

    def apart(self, here: FloatArray, target: FloatArray) -> FloatArray:
        """(n,) from `here` to `target`."""
        return np.where(self._endless, wrapped(target - here), target - here)

    def settled(self, here: FloatArray, target: FloatArray) -> bool:
        """Whether the joints have arrived; the gripper may hold something."""
        ways = np.abs(self.apart(here, target))[: len(self._settled)]
        return bool((ways <= self._settled).all())
