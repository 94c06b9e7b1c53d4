"""Joint commands from the smoothed pose stream, for arms that take joint positions.

The pose stream has its limits, and joints have theirs. Those of the joints act in three places: the
motion to a goal is planned with the shares of the pose's limits that the joints can follow
(`PoseToJoint.shares`); where they lag behind nevertheless, the pose waits for them (`time_rate`),
up to `STUCK_S`; and if they lag when the arm brakes, the joints stop within their own limits and
the pose follows them. An arm that stops does not make up for its lag.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from vla_zenoh.control.joint_follower import (
    POSTURE,
    POSTURE_1_S,
    DistanceConstraints,
    JointFollower,
    JointMotion,
)
from vla_zenoh.control.joint_space import BEND, check_ticks, followed_shares
from vla_zenoh.control.limits import (
    FULL,
    Shares,
    chain_motion_limits,
    into_workspace,
    joint_margins,
    stop_way,
)
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.reachability import Barriers
from vla_zenoh.control.smoothing import Motion, PosePath, Smoother
from vla_zenoh.control.states import STOPPING, MotionMode
from vla_zenoh.kinematics.kinematics import Kinematics, pose_error
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, pose_distance
from vla_zenoh.profile import Profile
from vla_zenoh.types import Cause, FloatArray, JointBound, JointCommand

REST = JointBound(1e-3, 3e-4)
"""Slower joints stand: an elbow approaches its posture for ever, and is within `REST` /
`POSTURE_1_S` of it then. No controller feels a step of this size in its reference's velocity."""
PULL_1_S = 25.0
"""Rate at which the pull to the posture rises and falls, as a critically damped spring."""
PULL_JERK = 1.4
"""Greatest jerk of that when it reverses, in speeds times `PULL_1_S` squared."""
LAG_M, LAG_RAD = 0.002, 0.01
"""Joints nearer to the pose than this follow it."""
FAR = 5.0
"""At this multiple of that distance the pose waits for them."""
LEAST_SPEED = 1e-3
"""Least share of the speed: a pose that stands cannot be planned with."""
JOINT_ROOM = (0.95, 0.9, 0.9)
"""Parts of the joints' velocity, acceleration and jerk used for planning: the path is curved in
joint space, and the elbow moves as well."""
PATH_PLACES = 3
"""Places of a path at which the joints are computed."""
BRAKE_BEND = 0.15
"""`BEND` of a brake, whose curvature effect falls with its speed."""
BRAKE_S = 0.1
"""A brake covers about the distance that the arm moves in this time."""
CREEPING, STUCK_S = 0.05, 0.5
"""A pose that advances at less than this rate for this long will not be reached."""
OUTSIDE_M = 1e-3
"""An arm further outside the box than this started there, and is moved inside."""
LENGTH_DAMPING = 1e-5 * np.eye(6)
"""Of the inverse for lengths alone: at a singularity they are large, and finite."""
PIECE, MOST_PIECES = JointBound(0.01, 0.003), 4
"""The way from the end of a pose's brake to that of the joints' own is looked at in such pieces."""
RESTING_STEPS = 2
"""Newton steps to the joints of a resting pose."""
ELBOW_S = 0.1
"""A released elbow continues to move for about this long."""


class PoseToJoint:
    """Joints that follow the pose stream by differential inverse kinematics.

    Without `barriers` only the box of the TCP bounds the joints.
    """

    def __init__(
        self, profile: Profile, kinematics: Kinematics, barriers: Barriers | None = None
    ) -> None:
        robot, limits = profile.robot, profile.limits
        self._kinematics = kinematics
        self.limits = chain_motion_limits(profile, kinematics)
        velocity, acceleration, jerk = self.limits
        home_rad = kinematics.ordered(robot.arm_joints, robot.home_rad)
        self._home_rad = home_rad if robot.posture == "home" else None
        self._bounds = limits
        self._constraints = DistanceConstraints(limits, barriers)
        self._follower = JointFollower(
            kinematics,
            home_rad,
            self._constraints,
            acceleration_rad_s2=acceleration,
            jerk_rad_s3=jerk,
            velocity_rad_s=velocity,
            margin_rad=joint_margins(limits.reach, kinematics),
            singularity_stop=limits.reach.singularity_stop,
            lead=(limits.lead_m, limits.lead_rad),
        )
        posture = POSTURE.of(kinematics.slides)
        most = float((jerk / posture).min()) / PULL_JERK
        self._pull_1_s = min(PULL_1_S, most**0.5)
        self._longest = posture / POSTURE_1_S
        """(n,) a posture further away pulls no faster."""
        self._rest, self._piece = REST.of(kinematics.slides), PIECE.of(kinematics.slides)
        self._dt_s, self._check_ticks = 1.0 / profile.timing.command_hz, check_ticks(profile)
        self._held_by: set[str] = set()
        self.restart(home_rad)

    def restart(self, joints_rad: FloatArray) -> None:
        """Stand at these joints (n,) in chain order; only while nothing is streamed."""
        self._now = JointMotion.standing(joints_rad)
        self._pull = self._pull_rate_1_s = 0.0
        self._stopping, self._ticks = False, 0
        self.keep_elbow()
        self.time_rate = 1.0
        """Rate of the pose's time, 0 to 1."""

    def keep_elbow(self) -> None:
        """Start an activation: the posture is that of the present joints, or home."""
        here_rad = self._now.position_rad
        self._posture_rad = here_rad if self._home_rad is None else self._home_rad
        self._waiting_s = 0.0

    def shares(self, motion: Motion, goal: Pose, box: FloatArray, *, bend: float = BEND) -> Shares:
        """Shares of the limits `Smoother.box` of a straight motion that the joints can follow.

        It begins near to the joints, and ends at `goal`.
        """
        (position_m, rotation), twist, _ = motion
        turn = log3(rotation.T @ goal.rotation)
        ways = np.concatenate([goal.position_m - position_m, turn])
        joint_ways, bends = self._ways(np.concatenate([ways[:3], rotation @ turn]))
        limits = np.array(JOINT_ROOM)[:, None] * np.array(self.limits)
        speed = float(np.linalg.norm(twist))
        return followed_shares(ways, box, speed, joint_ways, bends, limits, bend)

    def _ways(self, way: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joint displacements (n,) of a straight path of the TCP by `way` (6,), and their change.

        Both for the whole path in one unit of time.
        """
        found: list[FloatArray] = []
        joints = self._now.position_rad
        for _ in range(PATH_PLACES):
            found.append(_joint_way(self._kinematics.jacobian(joints), way))
            joints = joints + found[-1] / (PATH_PLACES - 1)
        bends = np.abs(np.diff(found, axis=0)).max(axis=0) * (PATH_PLACES - 1)
        return np.abs(found).max(axis=0), bends

    def brake(self, smoother: Smoother) -> None:
        """Bring the pose to rest as fast as the joints can."""
        if smoother.braking:
            return
        (position_m, rotation), twist, _ = smoother.motion
        way = BRAKE_S * twist
        ahead = Pose(position_m + way[:3], exp3(way[3:]) @ rotation)
        smoother.brake_together(self.shares(smoother.motion, ahead, smoother.box, bend=BRAKE_BEND))

    def stopping_rad(self, smoother: Smoother, ahead_s: float) -> list[FloatArray]:
        """(n,) each, joints on the way to rest and at rest, were the arm to brake in `ahead_s`.

        By the brake of the pose, by that of the joints, and between: joints that begin to lag in a
        brake stop by themselves from there.
        """
        joints = self._now.position_rad
        if smoother.at_rest and self.at_rest:
            return [joints]
        ahead = copy(smoother)
        if not ahead.braking:
            ahead.tick(self.time_rate * ahead_s / self._dt_s)
            self.brake(ahead)
        rest = ahead.resting_pose()
        jacobian, velocity = self._kinematics.jacobian(joints), self._now.velocity_rad_s
        elbow = velocity - _joint_way(jacobian, jacobian @ velocity)
        at_rest = joints + (ahead_s + ELBOW_S) * elbow
        for _ in range(RESTING_STEPS):
            here, jacobian = self._kinematics.pose_and_jacobian(at_rest)
            at_rest = at_rest + _joint_way(jacobian, pose_error(rest, here))
        acceleration, box = self._now.acceleration_rad_s2, np.array(self.limits)
        lagging = joints + stop_way(velocity, acceleration, box, ahead_s)
        apart = lagging - at_rest
        pieces = math.ceil(min(float((np.abs(apart) / self._piece).max()), MOST_PIECES)) or 1
        ends = [at_rest + number / pieces * apart for number in range(pieces + 1)]
        return [0.5 * (joints + at_rest), *ends]

    def tick(self, smoother: Smoother, *, braking: bool = False, elbow: bool = True) -> None:
        """Advance `smoother` by one tick and follow its pose, or come to rest if `braking`.

        With `elbow` the elbow moves towards the posture; not in a brake.
        """
        here = self._kinematics.forward(self._now.position_rad)
        lag = self._lag(here, smoother.motion.pose)
        if self._ticks % self._check_ticks == 0:
            self._constraints.update(self._now.position_rad)
        self._ticks += 1
        # Held joints approach a standing pose for as long as it takes.
        lags = lag > 1.0 or (bool(self._held_by) and smoother.at_rest)
        self._stopping = braking and (self._stopping or lags)
        if self._stopping:
            self._stop(smoother)
            return
        self.time_rate = min(max((FAR - lag) / (FAR - 1.0), LEAST_SPEED), 1.0)
        waiting = self.time_rate < CREEPING
        self._waiting_s = self._waiting_s + self._dt_s if waiting else 0.0
        motion = smoother.tick(self.time_rate)
        self._follower.posture_rad = self._pulled_to(1.0 if elbow and not braking else 0.0)
        twist = self.time_rate * motion.twist
        pose = self._inside(here, motion.pose)
        self._now, hits = self._follower.step(self._now, pose, twist, self._dt_s)
        found = {f"{hit.name} {hit.where}".strip() for hit in hits}
        self._held_by = found | (self._held_by if waiting else set())

    @property
    def stuck(self) -> str:
        """Why the joints will never reach the pose, empty while they follow."""
        if self._waiting_s < STUCK_S:
            return ""
        held = sorted(self._held_by)
        return (
            f"the joints cannot follow the pose: it has waited for them for {STUCK_S:g} s; "
            f"they are held by {', '.join(held) or 'nothing, so the arm cannot reach this pose'}"
        )

    def _inside(self, here: Pose, pose: Pose) -> Pose:
        """`pose`, kept in the box if the TCP is in it."""
        inside_m, outside_m = into_workspace(self._bounds, pose.position_m)
        if not outside_m or into_workspace(self._bounds, here.position_m)[1] > OUTSIDE_M:
            return pose
        return Pose(inside_m, pose.rotation)

    def _lag(self, here: Pose, pose: Pose) -> float:
        """Distance of the TCP from `pose`, in units of `LAG_M` and `LAG_RAD`."""
        apart_m, apart_rad = pose_distance(here, self._inside(here, pose))
        return max(apart_m / LAG_M, apart_rad / LAG_RAD)

    def _stop(self, smoother: Smoother) -> None:
        """Stop the joints within their limits; the pose follows them."""
        self._now = self._follower.brake(self._now, self._dt_s)
        self._pull = self._pull_rate_1_s = 0.0
        pose, twist, change = self.tcp
        # A motion planned from here must start within its limits.
        smoother.brake_from(Motion(pose, twist, np.clip(change, -smoother.box[1], smoother.box[1])))

    def _pulled_to(self, share: float) -> FloatArray:
        """The posture (n,) of this tick; its pull changes without a jerk of the elbow."""
        w, dt_s = self._pull_1_s, self._dt_s
        self._pull_rate_1_s += (w * w * (share - self._pull) - 2 * w * self._pull_rate_1_s) * dt_s
        self._pull += self._pull_rate_1_s * dt_s
        here_rad = self._now.position_rad
        way_rad = self._kinematics.nearest(self._posture_rad, here_rad) - here_rad
        longest = float((np.abs(way_rad) / self._longest).max())
        return here_rad + self._pull / max(longest, 1.0) * way_rad

    @property
    def position_rad(self) -> FloatArray:
        """(n,) the commanded joints."""
        return self._now.position_rad

    @property
    def tcp(self) -> Motion:
        """The motion of the TCP that the commanded joints make, without what their Jacobian's
        change adds to the acceleration."""
        position, velocity, acceleration, _ = self._now
        pose, jacobian = self._kinematics.pose_and_jacobian(position)
        return Motion(pose, jacobian @ velocity, jacobian @ acceleration)

    @property
    def at_rest(self) -> bool:
        """No commanded joint moves."""
        return bool((np.abs(self._now.velocity_rad_s) < self._rest).all())

    def command(self, state: str, cause: Cause | None) -> JointCommand:
        """The joint command of this tick."""
        return JointCommand(self._kinematics.arm_joints, *self._now[:3], state, cause)


class FollowedPath(PosePath):
    """Motion to goals that are poses, of a robot that takes joints.

    Args:
        profile: limits, rate.
        joints: follow the pose.
    """

    def __init__(self, profile: Profile, joints: PoseToJoint) -> None:
        self.joints = joints
        # Commanded joints have distance constraints of their own.
        super().__init__(profile, inside=False)

    @property
    def stuck(self) -> str:
        return self.joints.stuck

    @property
    def stands(self) -> bool:
        return self.at_rest and self.joints.at_rest

    @property
    def tcp(self) -> Motion:
        """The motion of the joints' TCP: it lags behind the path, and stays in the box."""
        return self.joints.tcp

    @property
    def joints_rad(self) -> FloatArray:
        return self.joints.position_rad

    strays_m = 5e-3
    """Joints that begin to lag in a brake end up to 6.4 mm from all places of `stopping_rad`, by
    2700 brakes on the way to goals that jump: two such arms, each kept this far before the least
    ``part_stop_m``, 5 mm, do not touch."""

    def stopping_rad(self, ahead_s: float) -> list[FloatArray]:
        return self.joints.stopping_rad(self, ahead_s)

    def step(self, mode: MotionMode) -> None:
        self.joints.tick(self, braking=mode in STOPPING, elbow=mode is MotionMode.FOLLOW)

    def stop(self) -> None:
        """Come to rest as fast as the joints can."""
        self.joints.brake(self)

    pause = stop

    def command(self, state: str, cause: Cause | None, goal: Goal | None) -> JointCommand:
        return self.joints.command(state, cause)

    def go_to(self, goal: Goal, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to the pose of `goal` within `shares`: joints that follow could do no more."""
        return super().go_to(goal, shares)

    def shares(self, goal: Goal) -> Shares:
        """Shares of the limits that the joints can follow on the way to a goal."""
        return self.joints.shares(self.motion, goal.pose, self.box)


def _joint_way(jacobian: FloatArray, way: FloatArray) -> FloatArray:
    """The least joint displacement (n,) that moves the TCP by `way` (6,)."""
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + LENGTH_DAMPING, way)
