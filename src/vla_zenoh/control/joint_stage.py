"""Joint commands out of the smoothed pose stream, for arms that take joint positions.

The pose stream has limits of its own, and joints have theirs. What joints cannot do is met in three
places: the way to a goal is planned with the shares of the pose's limits that the joints can take
(`JointStage.shares`); where they lag behind all the same the pose waits for them (`pace`); and a
brake that finds them lagging is theirs: each joint stops within its limits, and the pose is then
where they have brought it. An arm that is told to stop does not make up for what it lagged.
"""

from __future__ import annotations

import numpy as np
from ruckig import Trajectory

from vla_zenoh.control.differential import FollowSettings, JointFollower, JointMotion
from vla_zenoh.control.joint_reference import JointMotionLimits, JointReference, stop_from
from vla_zenoh.control.kinematics import Kinematics
from vla_zenoh.control.smoothing import FULL, Motion, Shares, Smoother
from vla_zenoh.control.so3 import Pose, distance, exp3, log3
from vla_zenoh.profile import Profile
from vla_zenoh.types import Cause, FloatArray, JointCommand

REST_RAD_S = 1e-5
PULL_1_S = 25.0
"""How fast the pull to the posture comes and goes, as a critically damped spring does."""
PULL_JERK = 1.4
"""Greatest jerk of that, whenever it turns round, in speeds times `PULL_1_S` squared."""
NEAR_M, NEAR_RAD = 0.002, 0.01
"""Joints that are nearer to the pose than this follow it."""
FAR = 5.0
"""So many times as far from it, and it waits for them."""
SLOWEST = 1e-3
"""Part of its pace that is always left: to stand is no motion to plan with."""
ROOM = (0.95, 0.9, 0.9)
"""Parts of the joints' velocity, acceleration and jerk that are planned with: the way is curved,
and the elbow moves besides."""
BEND = 0.5
"""Part of the acceleration that the way's bend may take, in the joints' space."""
PLACES = 3
"""Places of a way at which it is looked."""
BRAKE_BEND = 0.15
"""Likewise of a brake, which takes what it can get: it bends less and less as it gets slower."""
BRAKE_S = 0.1
"""A brake leads about as far as the arm goes in this time."""
LEAST_SHARE = 0.02
NOTHING = 1e-9
DAMPING = 1e-5


class JointStage:
    """Joints that follow the pose stream by differential inverse kinematics.

    Args:
        profile: joint limits, home as posture, rate.
        kinematics: of the arm.
    """

    def __init__(self, profile: Profile, kinematics: Kinematics) -> None:
        robot, limits = profile.robot, profile.limits
        size = len(robot.arm_joints)
        # The follower's joints are in chain order, the profile's in its own.
        velocity, acceleration, jerk = (
            kinematics.ordered(robot.arm_joints, limits.joint.of(name, size))
            for name in ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
        )
        self._kinematics = kinematics
        share = float(np.min(velocity / kinematics.velocity_rad_s))
        velocity = np.minimum(velocity, share * kinematics.velocity_rad_s)
        self._limits = JointMotionLimits(velocity, acceleration, jerk)
        self._posture_rad = kinematics.ordered(robot.arm_joints, robot.home_rad)
        settings = FollowSettings(
            acceleration_rad_s2=tuple(float(value) for value in acceleration),
            velocity_share=min(share, 1.0),
            joint_margin_rad=limits.reach.joint_margin_rad,
            singularity_stop=limits.reach.singularity_stop,
        )
        self._follower = JointFollower(kinematics, self._posture_rad, settings)
        most = float(jerk.min()) / PULL_JERK / settings.posture_rad_s
        self._pull_1_s = min(PULL_1_S, most**0.5)
        self._longest_rad = settings.posture_rad_s / settings.posture_1_s
        self._dt_s = 1.0 / profile.timing.command_hz
        self._names = kinematics.arm_joints
        self.restart(self._follower.posture_rad)

    def restart(self, joints_rad: FloatArray) -> None:
        """Stand at these joints (chain order); only for an arm that is not streamed to."""
        still = np.zeros(len(joints_rad))
        self._now = JointMotion(np.array(joints_rad, dtype=np.float64), still)
        self._acceleration = still
        self._pull = self._pull_rate_1_s = 0.0
        self._stop: Trajectory | None = None
        self._stop_s = 0.0
        self.pace = 1.0
        """Part of its own pace at which the pose goes on."""

    def shares(self, motion: Motion, goal: Pose, box: FloatArray, *, bend: float = BEND) -> Shares:
        """Of the limits of a straight motion to a pose, what the joints can follow.

        Args:
            motion: where it begins, near to the joints, and how fast.
            goal: where it ends.
            box: (3, 6) velocity, acceleration and jerk of every axis, see `Smoother.box`.
            bend: see `BEND`.
        """
        (position_m, rotation), twist, _ = motion
        turn = log3(rotation.T @ goal.rotation)
        ways = np.concatenate([goal.position_m - position_m, turn])
        length = float(np.linalg.norm(ways))
        if length < NOTHING:
            return FULL
        # All axes go together: the slowest one of the pose says how fast the way is taken.
        rates = (box / np.maximum(np.abs(ways), NOTHING)).min(axis=1)
        now = float(np.linalg.norm(twist)) / length
        joint_ways, bends = self._ways(np.concatenate([ways[:3], rotation @ turn]))
        limits = np.array(ROOM)[:, None] * np.array(self._limits)
        needed = np.maximum(rates[:, None] * joint_ways, NOTHING)
        velocity, _, jerk = (limits / needed).min(axis=1)
        fastest = min(rates[0] * velocity, float(np.min(np.sqrt(bend * limits[1] / bends))))
        reached = min(fastest, (now * now + rates[1]) ** 0.5)
        left = np.maximum(limits[1] - bends * reached * reached, (1 - bend) * limits[1])
        parts = np.clip([fastest / rates[0], (left / needed[1]).min(), jerk], LEAST_SHARE, 1.0)
        return Shares(*(float(part) for part in parts))

    def _ways(self, way: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far (n,) each joint goes on a way (6,) of the TCP, and how much (n,) that changes.

        Both of the whole way taken in one unit of time.
        """
        found: list[FloatArray] = []
        joints = self._now.position_rad
        for _ in range(PLACES):
            jacobian = self._kinematics.jacobian(joints)
            square = jacobian @ jacobian.T + DAMPING * np.eye(6)
            found.append(jacobian.T @ np.linalg.solve(square, way))
            joints = joints + found[-1] / (PLACES - 1)
        bends = np.abs(np.diff(found, axis=0)).max(axis=0) * (PLACES - 1)
        return np.abs(found).max(axis=0), np.maximum(bends, NOTHING)

    def brake(self, smoother: Smoother) -> None:
        """Let the pose come to rest as fast as the joints can."""
        if smoother.braking:
            return
        (position_m, rotation), twist, _ = smoother.motion
        way = BRAKE_S * twist
        ahead = Pose(position_m + way[:3], exp3(way[3:]) @ rotation)
        smoother.brake(self.shares(smoother.motion, ahead, smoother.box, bend=BRAKE_BEND))

    def tick(self, smoother: Smoother, *, braking: bool = False, elbow: bool = True) -> None:
        """Follow the pose for one tick, or stop; `smoother` is moved on.

        Args:
            smoother: the pose.
            braking: it comes to rest. An arm that brakes leaves its elbow where it is.
            elbow: it may go to its posture.
        """
        lag = self._lag(smoother.motion.pose)
        if not braking:
            self._stop = None
        elif self._stop is None and lag > 1.0:
            reference = JointReference(*self._now, self._acceleration)
            self._stop, self._stop_s = stop_from(reference, self._limits), 0.0
        if self._stop is not None:
            self._stopping(self._stop, smoother)
            return
        self.pace = min(max((FAR - lag) / (FAR - 1.0), SLOWEST), 1.0)
        motion = smoother.tick(self.pace)
        self._follower.posture_rad = self._pulled_to(1.0 if elbow and not braking else 0.0)
        before = self._now.velocity_rad_s
        twist = self.pace * motion.twist
        self._now, _ = self._follower.step(self._now, motion.pose, twist, self._dt_s)
        self._acceleration = (self._now.velocity_rad_s - before) / self._dt_s

    def _lag(self, pose: Pose) -> float:
        """How far the joints are from a pose, in times of what is near."""
        apart_m, apart_rad = distance(self._kinematics.forward(self._now.position_rad), pose)
        return max(apart_m / NEAR_M, apart_rad / NEAR_RAD)

    def _stopping(self, path: Trajectory, smoother: Smoother) -> None:
        """The joints stop by themselves, and the pose is where that brings the TCP."""
        self._stop_s += self._dt_s
        position, velocity, acceleration = map(np.array, path.at_time(self._stop_s))
        if self._stop_s >= path.duration:
            velocity = acceleration = np.zeros(len(position))
        self._now, self._acceleration = JointMotion(position, velocity), acceleration
        self._pull = self._pull_rate_1_s = 0.0
        pose, jacobian = self._kinematics.pose_and_jacobian(position)
        # Whoever takes this stop back plans from here: with no more than a plan may have.
        change = np.clip(jacobian @ acceleration, -smoother.box[1], smoother.box[1])
        smoother.brake_from(Motion(pose, jacobian @ velocity, change))

    def _pulled_to(self, share: float) -> FloatArray:
        """The posture (n,) of this tick: its pull comes and goes without a jerk of the elbow."""
        w, dt_s = self._pull_1_s, self._dt_s
        self._pull_rate_1_s += (w * w * (share - self._pull) - 2 * w * self._pull_rate_1_s) * dt_s
        self._pull += self._pull_rate_1_s * dt_s
        way_rad = self._posture_rad - self._now.position_rad
        shortened = min(1.0, self._longest_rad / max(float(np.abs(way_rad).max()), 1e-9))
        return self._now.position_rad + self._pull * shortened * way_rad

    @property
    def at_rest(self) -> bool:
        """No joint moves."""
        return float(np.abs(self._now.velocity_rad_s).max()) < REST_RAD_S

    def command(self, state: str, cause: Cause | None) -> JointCommand:
        """Where the joints have to be now."""
        return JointCommand(self._names, *self._now, self._acceleration, state=state, cause=cause)
