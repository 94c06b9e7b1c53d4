"""When a primitive ends: target reached, no more progress, or a condition of a run. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, pose_distance, pose_of
from vla_zenoh.types import FloatArray, GripperState, JointBound, PoseState
from vla_zenoh_primitives.requests import Until

NEAR_M, NEAR_RAD = 1e-3, 2e-3
NEAR_JOINT = JointBound(NEAR_RAD, NEAR_M)
"""Tolerances of the measured state for a reached target."""
SLOW_M_S, SLOW_RAD_S = 0.005, 0.02
SETTLED_S = 0.1
PROGRESS = 0.05
"""Share of the remaining distance that must be covered within `STUCK_S`."""
STUCK_S = 2.5
LEAST_SPEED = 0.05
GRIPPED_S = 0.7
"""A gripper that has not moved for this long stands: a command takes a moment to arrive."""
MOVED_M = 0.001
"""Fingers that move further do move: not every robot says so. A sensor's noise is less."""
WIDTH_TOLERANCE_M = 0.003
SHUT, WIDE = 0.1, 0.9
"""Shares of the largest width."""


@dataclass(frozen=True)
class Sight:
    """Observed state of the robot at one moment.

    Args:
        joints_rad: (n,) measured, in the order of the kinematics.
        done: the model reported that it is done.
        speed: override in force, 0 to 1.
    """

    now_s: float
    pose: PoseState
    joints_rad: FloatArray
    gripper: GripperState
    done: bool = False
    speed: float = 1.0

    @property
    def slow(self) -> bool:
        """The arm stands, as far as can be measured."""
        twist = self.pose.twist
        linear, angular = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
        return bool(linear < SLOW_M_S and angular < SLOW_RAD_S)


class Arrival:
    """Ends a motion: ``reached``, or ``bound`` once it makes no more progress.

    Args:
        pose: target of the TCP.
        joints_rad: (n,) joint target in the order of the kinematics; None: only the pose is
            checked.
        arm: of these joints; None: all of them turn, and have ends.
    """

    def __init__(
        self, pose: Pose, joints_rad: FloatArray | None = None, arm: Kinematics | None = None
    ) -> None:
        self.pose, self.joints_rad, self._arm = pose, joints_rad, arm
        self._best = np.inf
        self._gained_s = self._there_s = -np.inf

    def off(self, sight: Sight) -> tuple[float, float]:
        """Distance of the TCP from the target, m; its angle, or that of the joints, rad."""
        off_m, off_rad = pose_distance(pose_of(sight.pose), self.pose)
        if self.joints_rad is not None:
            off, slides = self._joints_off(sight, self.joints_rad)
            off_rad = float(off[~slides].max(initial=0.0))
        return off_m, off_rad

    def _joints_off(
        self, sight: Sight, target_rad: FloatArray
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(n,) how far each joint is from its target, and which joints slide."""
        slides = np.zeros(len(target_rad), bool)
        if self._arm is not None:
            target_rad, slides = self._arm.nearest(target_rad, sight.joints_rad), self._arm.slides
        return np.abs(sight.joints_rad - target_rad), slides

    def _left(self, sight: Sight) -> float:
        """How far the arm is from its target, in tolerances.

        With a joint target the TCP does not count: its error includes the arm's calibration.
        """
        if self.joints_rad is not None:
            off, slides = self._joints_off(sight, self.joints_rad)
            return float((off / NEAR_JOINT.of(slides)).max())
        off_m, off_rad = self.off(sight)
        return max(off_m / NEAR_M, off_rad / NEAR_RAD)

    def check(self, sight: Sight) -> str:
        left = self._left(sight)
        near = left < 1.0
        if not (near and sight.slow):
            self._there_s = -np.inf
        elif self._there_s == -np.inf:
            self._there_s = sight.now_s
        elif sight.now_s - self._there_s >= SETTLED_S:
            return "reached"
        if near or left < self._best * (1 - PROGRESS):
            self._best, self._gained_s = left, sight.now_s
        stuck = sight.now_s - self._gained_s > STUCK_S / max(sight.speed, LEAST_SPEED)
        return "bound" if stuck else ""


class Gripped:
    """Ends a motion of the gripper: ``reached``, or ``bound`` if it stops elsewhere.

    Args:
        closing: until something is held, or the fingers meet.
    """

    def __init__(self, width_m: float, *, closing: bool) -> None:
        self._width_m, self._closing = width_m, closing
        self._moved_s, self._stood_m = -np.inf, np.inf

    def check(self, sight: Sight) -> str:
        gripper = sight.gripper
        if gripper.moving or abs(gripper.opening_m - self._stood_m) > MOVED_M:
            self._moved_s, self._stood_m = sight.now_s, gripper.opening_m
        if sight.now_s - self._moved_s < GRIPPED_S:
            return ""
        off_m = abs(gripper.opening_m - self._width_m)
        return "reached" if self._closing or off_m < WIDTH_TOLERANCE_M else "bound"


class RunEnding:
    """Ends a run: the name of the first condition that holds."""

    def __init__(self, until: Until, max_width_m: float) -> None:
        self._until, self._max_width_m = until, max_width_m
        self._before_n: FloatArray | None = None
        self._moved_s: float | None = None

    def check(self, sight: Sight) -> str:
        return next((name for name in self._until.names if getattr(self, f"_{name}")(sight)), "")

    def _gripper(self, sight: Sight) -> bool:
        gripper, part = sight.gripper, sight.gripper.opening_m / self._max_width_m
        if self._until.gripper == "open":
            return part > WIDE and not gripper.moving
        return gripper.holding or (part < SHUT and not gripper.moving)

    def _inside(self, sight: Sight) -> bool:
        box, at_m = self._until.inside, sight.pose.position_m
        return box is not None and bool(np.all((box.low_m <= at_m) & (at_m <= box.high_m)))

    def _force_n(self, sight: Sight) -> bool:
        if sight.pose.wrench is None:
            return False
        force_n = sight.pose.wrench[:3]
        if self._before_n is None:
            self._before_n = force_n
        return bool(np.linalg.norm(force_n - self._before_n) >= (self._until.force_n or 0.0))

    def _still_s(self, sight: Sight) -> bool:
        if not sight.slow or sight.gripper.moving:
            self._moved_s = sight.now_s
        limit_s = self._until.still_s or 0.0
        return self._moved_s is not None and sight.now_s - self._moved_s >= limit_s

    def _done(self, sight: Sight) -> bool:
        return sight.done


Ending = Arrival | Gripped | RunEnding
"""Its `check` judges each `Sight` in turn: the reason why it is over, empty while it is not."""
