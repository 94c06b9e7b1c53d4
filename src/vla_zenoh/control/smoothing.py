"""Jerk-limited motion of the TCP to a pose that may change at any tick: Ruckig on R^3 x SO(3).

Translation is planned in the base frame. Rotation is planned as the rotation vector ``r`` of
``R_anchor^T R``; at every new target the anchor moves to the current smoothed rotation, so ``r``
starts at zero, stays small, never wraps at pi, and velocity and acceleration carry over exactly
(at r = 0, r' is the body velocity and r'' the body acceleration). The motion of these six axes is
that of `vla_zenoh.control.axis_smoothing`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.axis_smoothing import OVERSHOOT, AxisSmoother, AxisState
from vla_zenoh.control.limits import (
    FULL,
    PAUSE_LEAD_M,
    PAUSE_LEAD_RAD,
    LimitHit,
    MotionLimits,
    Shares,
    into_workspace,
    leash,
    motion_limits,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.states import MotionMode
from vla_zenoh.kinematics.so3 import (
    Pose,
    exp3,
    interpolate,
    log3,
    orthonormal,
    pose_distance,
    quat_from_rotation,
    spatial_rates,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import Cause, FloatArray, JointCommand, PoseCommand


class Motion(NamedTuple):
    """One point of the smoothed motion, base frame.

    Args:
        pose: position (3,) m, rotation (3, 3).
        twist: (6,) m/s, rad/s.
        acceleration: (6,) m/s^2, rad/s^2.
    """

    pose: Pose
    twist: FloatArray
    acceleration: FloatArray

    def axis_rates(self) -> tuple[FloatArray, FloatArray]:
        """(6,) twist and acceleration; those of rotation in axes that turn with the arm."""
        body = self.pose.rotation.T
        twist, change = (np.append(rates[:3], body @ rates[3:]) for rates in self[1:])
        return twist, change


class Smoother(AxisSmoother):
    """Trajectory generator: moves to targets within motion limits, or brakes.

    Args:
        pose: initial pose.
        dt_s: duration of a tick.
        limits: of the motion.
        bounds_m: lower and upper corner (3,) of the box to stay in; None: none.
    """

    def __init__(
        self,
        pose: Pose,
        dt_s: float,
        limits: MotionLimits,
        bounds_m: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        self._anchor = np.eye(3)
        super().__init__(np.zeros(6), dt_s, limits.box, (slice(0, 3), slice(3, 6)), bounds_m)
        self.reset(pose)

    def reset(self, pose: Pose) -> None:
        """Stand at `pose` without any motion; only while nothing is streamed."""
        self._anchor = orthonormal(pose.rotation)
        self.stand(np.array([*pose.position_m, 0.0, 0.0, 0.0]))

    def stand(self, position: FloatArray) -> None:
        super().stand(position)
        pose = Pose(self.state.position[:3], self._anchor)
        self.motion = Motion(pose, np.zeros(6), np.zeros(6))

    def target(self, pose: Pose, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to `pose` from the present state; see `AxisSmoother.move_to`."""
        self._settle(shares)
        target = np.array([*pose.position_m, *log3(self._anchor.T @ pose.rotation)])
        return self._plan_to(target, shares, all_to_stop)

    def resting_pose(self) -> Pose:
        """Brake, and return where the brake will end."""
        if self.at_rest:
            return self.motion.pose
        end = self.braked()
        if self._plan is None:
            return self.motion.pose
        return Pose(end[:3], orthonormal(self._anchor @ exp3(end[3:])))

    def brake_from(self, motion: Motion) -> None:
        """Brake from the state of another motion."""
        self.reset(motion.pose)
        self.state = AxisState(self.state.position, *motion.axis_rates())
        self.motion = motion
        self.brake()

    # -- moving -------------------------------------------------------------------------------
    def tick(self, part: float = 1.0) -> Motion:
        """Advance by one tick.

        Args:
            part: of the tick, by which the motion advances, for a slow follower. Twist and
                acceleration are those of a whole tick.
        """
        if not self.advance(part):
            return self.motion
        position, velocity, acceleration = self.state
        rotation = self._anchor @ exp3(position[3:])
        spin, spin_change = spatial_rates(position[3:], velocity[3:], acceleration[3:])
        twist, change = velocity.copy(), acceleration.copy()
        twist[3:], change[3:] = self._anchor @ spin, self._anchor @ spin_change
        self.motion = Motion(Pose(position[:3].copy(), rotation), twist, change)
        return self.motion

    @property
    def _rates(self) -> tuple[FloatArray, FloatArray]:
        return self.motion[1:]

    def _settle(self, shares: Shares) -> None:
        """Move the anchor to the present rotation, and set noise to zero."""
        position, velocity, acceleration = self.state
        turning = position[3:], velocity[3:], acceleration[3:]
        spin, spin_change = spatial_rates(*turning, side=-1.0)
        self._anchor = orthonormal(self._anchor @ exp3(position[3:]))
        self.state = AxisState(
            np.concatenate([position[:3], np.zeros(3)]),
            np.concatenate([velocity[:3], spin]),
            np.concatenate([acceleration[:3], spin_change]),
        )
        super()._settle(shares)


class PosePath(Smoother):
    """Motion to goals that are poses, of a robot that takes poses.

    `FollowedPath` and `JointPath` are the same of a robot that takes joints.

    Args:
        profile: limits, rate.
        inside: no motion leaves the workspace box.
    """

    stuck = ""
    """Why the arm will not reach its goal, empty while it follows."""
    strays_m = 0.0
    """How far beside all places of `stopping_rad` it may come to rest."""

    def __init__(self, profile: Profile, *, inside: bool = True) -> None:
        start = Pose(np.zeros(3), np.eye(3))  # until `reset`
        limits = self._bounds = profile.limits
        box = workspace_corners(limits) if inside else None
        super().__init__(start, 1.0 / profile.timing.command_hz, motion_limits(limits), box)

    @property
    def tcp(self) -> Motion:
        """The commanded motion of the TCP."""
        return self.motion

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joints commanded, None where poses are."""
        return None

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        """(n,) each, commanded joints on the way to rest and at rest, from a brake in `ahead_s`."""
        return []

    def step(self, mode: MotionMode) -> None:
        """Advance by one tick."""
        self.tick()

    def stop(self) -> None:
        """Come to rest as soon as possible."""
        self.brake()

    def pause(self) -> None:
        """Come to rest on the path, to go on from there."""
        self.brake_on_line()

    def taken_hits(self) -> list[LimitHit]:
        """Limits that acted on the motion since the last call."""
        return []

    def command(
        self, state: str, cause: Cause | None, goal: Goal | None
    ) -> PoseCommand | JointCommand:
        """The command of this tick on the way to `goal`; None: where the arm is."""
        (position_m, rotation), twist, acceleration = self.motion
        heads_m, heads = (position_m, rotation) if goal is None else goal.pose
        return PoseCommand(
            position_m,
            quat_from_rotation(rotation),
            twist,
            acceleration,
            heads_m,
            quat_from_rotation(heads),
            state,
            cause,
        )

    def leash(self, goal: Goal, ahead_s: float) -> tuple[Goal, list[LimitHit]]:
        """`goal`, or a nearer one on the leash, and the limits that acted.

        It is no further outside the box than the TCP is now: one that began there only comes in.
        """
        (position_m, rotation), twist, acceleration = self.tcp
        way = ahead_s * (twist + 0.5 * ahead_s * acceleration)
        ahead = Pose(position_m + way[:3], exp3(way[3:]).dot(rotation))
        pose, hits = leash(self._bounds, goal.pose, ahead)
        inside_m, outside_m = into_workspace(self._bounds, pose.position_m, position_m)
        if outside_m > OVERSHOOT:
            hits.append(LimitHit("workspace", outside_m, 0.0))
            pose = Pose(inside_m, pose.rotation)
        if not hits:
            return goal, hits
        return Goal(pose, goal.width_m, slowdown=goal.slowdown, response=goal.response), hits

    def near(self, goal: Goal) -> Goal:
        """`goal`, or one so near that the arm can retreat from there."""
        here = self.motion.pose
        apart_m, apart_rad = pose_distance(here, goal.pose)
        share = 1 / max(apart_m / PAUSE_LEAD_M, apart_rad / PAUSE_LEAD_RAD, 1.0)
        if share >= 1.0:
            return goal
        nearer = interpolate(here, goal.pose, share)
        inside_m, _ = into_workspace(self._bounds, nearer.position_m, self.tcp.pose.position_m)
        nearer = Pose(inside_m, nearer.rotation)
        return Goal(nearer, goal.width_m, slowdown=goal.slowdown, response=goal.response)

    def resting_goal(self, actual: Pose, width_m: float) -> Goal:
        """Brake; where that ends, no further outside the box than the `actual` arm is."""
        rest, (low, high) = self.resting_pose(), workspace_corners(self._bounds)
        least, most = np.minimum(low, actual.position_m), np.maximum(high, actual.position_m)
        return Goal(Pose(np.clip(rest.position_m, least, most), rest.rotation), width_m)

    def go_to(self, goal: Goal, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to the pose of `goal`; see `AxisSmoother.move_to`."""
        return self.target(goal.pose, shares, all_to_stop=all_to_stop)

    def way_to(self, goal: Goal) -> FloatArray:
        """(6,) from the smoothed pose to that of `goal`, m and rad in its own axes."""
        (position_m, rotation), (there_m, there) = self.motion.pose, goal.pose
        return np.concatenate([there_m - position_m, log3(rotation.T @ there)])

    def axis_rates(self) -> tuple[FloatArray, FloatArray]:
        """(6,) velocity and acceleration, in the same axes."""
        return self.motion.axis_rates()

    def shares(self, goal: Goal) -> Shares:
        """Shares of the limits for the way to a goal."""
        return FULL
