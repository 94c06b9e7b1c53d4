"""Smooth motion of the TCP, with the joints that follow it where joints are commanded."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from operator import is_
from typing import TYPE_CHECKING, Self

import numpy as np

from vla_zenoh.control.joint_space import JointPath
from vla_zenoh.control.limits import (
    HELD_LEAD_M,
    HELD_LEAD_RAD,
    LimitHit,
    leash,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.smoothing import FULL, Motion, Shares, Smoother, motion_limits
from vla_zenoh.kinematics.so3 import Pose, exp3, interpolate, pose_distance, quat_from_rotation
from vla_zenoh.profile import Profile
from vla_zenoh.types import Cause, FloatArray, PoseCommand, computed

if TYPE_CHECKING:
    from vla_zenoh.control.pose_to_joint import PoseToJoint


class PosePath:
    """Motion to goals that are poses; `JointPath` is the same for joints.

    Args:
        start: pose to stand at.
        profile: limits, rate.
        joints: that follow the pose; None: poses are commanded.
    """

    def __init__(self, start: Pose, profile: Profile, joints: PoseToJoint | None) -> None:
        self._limits, self._joints = profile.limits, joints
        # Commanded joints have distance constraints of their own.
        inside = workspace_corners(self._limits) if joints is None else None
        dt_s = 1.0 / profile.timing.command_hz
        self._smoother = Smoother(start, dt_s, motion_limits(self._limits), inside)
        self.box = self._smoother.box

    # -- state --------------------------------------------------------------------------------
    @property
    def motion(self) -> Motion:
        """The present motion of the TCP."""
        return self._smoother.motion

    @property
    def state(self) -> object:
        """Another object after every change of the motion."""
        return self._smoother.state

    @property
    def at_rest(self) -> bool:
        """The pose stands, and is not about to move; joints that follow it may lag."""
        return self._smoother.at_rest

    @property
    def failures(self) -> int:
        """See `AxisSmoother`."""
        return self._smoother.failures

    def reset(self, pose: Pose) -> None:
        """Stand at `pose`; only while nothing is streamed."""
        self._smoother.reset(pose)

    def fork(self) -> Self:
        """A copy that moves by itself."""
        fork = copy(self)
        fork._smoother = self._smoother.fork()
        return fork

    def adopt(self, fork: Self) -> None:
        """Take over the motion of a `fork` that was made of the present state."""
        self._smoother.adopt(fork._smoother)

    # -- goals --------------------------------------------------------------------------------
    def leash(self, goal: Goal, ahead_s: float) -> tuple[Goal, list[LimitHit]]:
        """`goal`, or a nearer one on the leash, and the limits that acted."""
        if self._well_within_leash(goal.pose, ahead_s):
            return goal, []
        (position_m, rotation), twist, acceleration = self.motion
        way = ahead_s * (twist + 0.5 * ahead_s * acceleration)
        ahead = Pose(position_m + way[:3], exp3(way[3:]).dot(rotation))
        pose, hits = leash(self._limits, goal.pose, ahead)
        return replace(goal, pose=pose, joints_rad=None) if hits else goal, hits

    def _well_within_leash(self, goal: Pose, ahead_s: float) -> bool:
        """Whether the leash is long enough wherever the arm will be; cheaper than computing where.

        It moves no further than at its speed plus what the acceleration adds.
        """
        limits, (pose, twist, acceleration) = self._limits, self.motion
        apart_m, apart_rad = pose_distance(goal, pose)
        x, y, z, rx, ry, rz = map(abs, twist.tolist())
        ax, ay, az, arx, ary, arz = map(abs, acceleration.tolist())
        way_m = ahead_s * (x + y + z + ahead_s * (ax + ay + az))
        turn_rad = ahead_s * (rx + ry + rz + ahead_s * (arx + ary + arz))
        return apart_m + way_m <= limits.lead_m and apart_rad + turn_rad <= limits.lead_rad

    def near(self, goal: Goal) -> Goal:
        """`goal`, or one so near that the arm can retreat from there."""
        here = self.motion.pose
        apart_m, apart_rad = pose_distance(here, goal.pose)
        share = 1 / max(apart_m / HELD_LEAD_M, apart_rad / HELD_LEAD_RAD, 1.0)
        if share >= 1.0:
            return goal
        return replace(goal, pose=interpolate(here, goal.pose, share), joints_rad=None)

    def resting_goal(self, actual: Pose, width_m: float) -> Goal:
        """Brake; where that ends, no further outside the box than the `actual` arm is."""
        rest, (low, high) = self._smoother.resting_pose(), workspace_corners(self._limits)
        least, most = np.minimum(low, actual.position_m), np.maximum(high, actual.position_m)
        return Goal(Pose(np.clip(rest.position_m, least, most), rest.rotation), width_m)

    # -- motion -------------------------------------------------------------------------------
    def target(self, goal: Goal, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to the pose of `goal`; see `AxisSmoother.move_to`."""
        return self._smoother.target(goal.pose, shares, all_to_stop=all_to_stop)

    def way_to(self, goal: Goal) -> FloatArray:
        """(6,) from the smoothed pose to that of `goal`, m and rad in its own axes."""
        return self._smoother.way_to(goal.pose)

    def axis_rates(self) -> tuple[FloatArray, FloatArray]:
        """(6,) velocity and acceleration, in the same axes."""
        return self._smoother.axis_rates()

    def shares(self, goal: Goal) -> Shares:
        """Shares of the limits that the joints can follow on the way to a goal."""
        if self._joints is None:
            return FULL
        return self._joints.shares(self.motion, goal.pose, self.box)

    def brake(self, shares: Shares | None = None) -> None:
        """Come to rest within `shares`, on the path; None: each axis as fast as it can."""
        if self._joints is None:
            self._smoother.brake(shares)
        else:
            self._joints.brake(self._smoother)

    def tick(self, *, braking: bool, elbow: bool) -> None:
        """Advance by one tick; see `PoseToJoint.tick`."""
        if self._joints is None:
            self._smoother.tick()
        else:
            self._joints.tick(self._smoother, braking=braking, elbow=elbow)

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        """(n,) each, commanded joints on the way to rest and at rest, from a brake in `ahead_s`."""
        assert self._joints is not None
        return self._joints.stopping_rad(self._smoother, ahead_s)


Mover = PosePath | JointPath
"""What moves the arm."""


class PoseCommands:
    """The pose commands of a motion; what stays the same is computed once."""

    def __init__(self) -> None:
        self._sent: PoseCommand | None = None
        self._made_of: tuple[Motion, Goal | None, str, Cause | None] | None = None

    def of(self, motion: Motion, goal: Goal | None, state: str, cause: Cause | None) -> PoseCommand:
        """The command of this tick, on the way to `goal`."""
        made_of = motion, goal, state, cause
        if self._made_of and self._sent and all(map(is_, made_of, self._made_of)):
            return self._sent  # the arm is at rest
        (position_m, rotation), twist, acceleration = motion
        quat_xyzw = quat_from_rotation(rotation)
        if goal is None:
            heads_m, heads_xyzw = position_m, quat_xyzw
        elif self._sent and self._made_of and goal is self._made_of[1]:
            heads_m, heads_xyzw = self._sent.goal_position_m, self._sent.goal_quat_xyzw
        else:
            heads_m, heads_xyzw = goal.pose.position_m, quat_from_rotation(goal.pose.rotation)
        moves, heads = (position_m, quat_xyzw, twist, acceleration), (heads_m, heads_xyzw)
        self._made_of = made_of
        self._sent = computed(PoseCommand, *moves, *heads, state, cause)
        return self._sent
