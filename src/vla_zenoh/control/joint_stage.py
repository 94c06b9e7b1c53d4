"""Joint commands out of the smoothed pose stream, for arms that take joint positions."""

from __future__ import annotations

import numpy as np

from vla_zenoh.control.differential import FollowSettings, JointFollower, JointMotion
from vla_zenoh.control.kinematics import Kinematics
from vla_zenoh.control.smoothing import Motion
from vla_zenoh.profile import Profile
from vla_zenoh.types import Cause, FloatArray, JointCommand

REST_RAD_S = 1e-5
PULL_1_S = 25.0
"""How fast the pull to the posture comes and goes, as a critically damped spring does."""
PULL_JERK = 1.4
"""Greatest jerk of that, whenever it turns round, in speeds times `PULL_1_S` squared."""


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
        acceleration = kinematics.ordered(
            robot.arm_joints, limits.joint.of("acceleration_rad_s2", size)
        )
        velocity = kinematics.ordered(robot.arm_joints, limits.joint.of("velocity_rad_s", size))
        share = float(np.min(velocity / kinematics.velocity_rad_s))
        self._posture_rad = kinematics.ordered(robot.arm_joints, robot.home_rad)
        settings = FollowSettings(
            acceleration_rad_s2=tuple(float(value) for value in acceleration),
            velocity_share=min(share, 1.0),
            joint_margin_rad=limits.reach.joint_margin_rad,
            singularity_stop=limits.reach.singularity_stop,
        )
        self._follower = JointFollower(kinematics, self._posture_rad, settings)
        jerk_rad_s3 = min(limits.joint.of("jerk_rad_s3", size))
        self._pull_1_s = min(PULL_1_S, (jerk_rad_s3 / PULL_JERK / settings.posture_rad_s) ** 0.5)
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

    def tick(self, motion: Motion, *, braking: bool = False) -> None:
        """Follow for one tick; an arm that brakes leaves its elbow where it is."""
        self._follower.posture_rad = self._pulled_to(0.0 if braking else 1.0)
        before = self._now.velocity_rad_s
        self._now, _ = self._follower.step(self._now, motion.pose, motion.twist, self._dt_s)
        self._acceleration = (self._now.velocity_rad_s - before) / self._dt_s

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
