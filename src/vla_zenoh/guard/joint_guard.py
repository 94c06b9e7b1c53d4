"""Guard of a stream of joint positions on the robot's side; see `vla_zenoh.guard.pose_guard`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.limits import JointMotionLimits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN, GovernedPath, GovernorLimits
from vla_zenoh.guard.stream_guard import StreamGuard
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh.types.commands import JointReference


class JointGuardLimits(NamedTuple):
    """Limits of a joint stream on the robot's side.

    Args:
        timeout_s: silence after which the guard brakes.
        brake: of its own stop; faster commands are rejected.
        lower_rad: (n,) lower ends of the joint ranges.
        upper_rad: (n,) upper ends.
        jump_rad: a command may be this far from the reference in force, each joint.
        begin_rad: the first command of a stream may be this far from where the arm stands.
        begin_rad_s: and it may move this fast: our streams begin at rest.
    """

    timeout_s: float
    brake: JointMotionLimits
    lower_rad: FloatArray
    upper_rad: FloatArray
    jump_rad: float = 0.05
    begin_rad: float = 0.004
    begin_rad_s: float = 0.1


class JointSpace:
    """Space of joint positions (n,); an offset is their difference."""

    def rest(self, motion: JointReference) -> JointReference:
        """At rest at the position of `motion`."""
        return JointReference.at_rest(motion.position_rad)

    def speed(self, motion: JointReference) -> GovernedPath:
        """Velocity and acceleration."""
        _, velocity_rad_s, acceleration_rad_s2 = motion
        return GovernedPath(np.zeros(len(velocity_rad_s)), velocity_rad_s, acceleration_rad_s2)

    def beside(self, base: JointReference, way: GovernedPath) -> JointReference:
        """The motion at the offset `way` from `base`."""
        return JointReference(base[0] + way[0], base[1] + way[1], base[2] + way[2])

    def apart(self, motion: JointReference, base: JointReference) -> GovernedPath:
        """The offset of `motion` from `base`."""
        return GovernedPath(motion[0] - base[0], motion[1] - base[1], motion[2] - base[2])

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Every joint counts by itself."""
        return np.abs(shares)


class JointGuard(StreamGuard[JointReference]):
    """Guard of a stream of joint positions.

    Args:
        names: of the arm's joints, in the order of every (n,) here.
        position_rad: where the arm stands.
        dt_s: period of the controller.
        limits: of the stream.
    """

    def __init__(
        self,
        names: Sequence[str],
        position_rad: FloatArray,
        dt_s: float,
        limits: JointGuardLimits,
    ) -> None:
        self._names, self._limits = tuple(names), limits
        whole = np.ones(len(position_rad))
        brake = GovernorLimits(*limits.brake, axis=whole, beside=whole)
        super().__init__(JointSpace(), position_rad, dt_s, limits.timeout_s, brake)

    def _standing(self, here: FloatArray) -> JointReference:
        return JointReference.at_rest(here)

    def _admit(self, record: JointCommand) -> JointReference | str:
        """The command in the arm's own order; ``names``, ``out_of_range`` are reasons as well."""
        wanted = self._ordered(record)
        if wanted is None:
            return "names"
        here, limits = self.motion.position_rad, self._limits
        jump_rad = limits.jump_rad if self.following else limits.begin_rad
        if (np.abs(wanted.position_rad - self._expected.position_rad) > jump_rad).any():
            return "jump"
        if (np.abs(wanted.velocity_rad_s) > limits.brake.velocity_rad_s).any() or (
            np.abs(wanted.acceleration_rad_s2) > limits.brake.acceleration_rad_s2
        ).any():
            return "too_fast"
        if not self.following and (np.abs(wanted.velocity_rad_s) > limits.begin_rad_s).any():
            return "too_fast"
        # An arm outside its range may come back, but go no further out.
        if (wanted.position_rad < np.minimum(limits.lower_rad, here)).any() or (
            wanted.position_rad > np.maximum(limits.upper_rad, here)
        ).any():
            return "out_of_range"
        return wanted

    def _ordered(self, record: JointCommand) -> JointReference | None:
        """The command in the arm's order of joints, None if it names other joints."""
        columns = (record.position_rad, record.velocity_rad_s, record.acceleration_rad_s2)
        if record.names == self._names:
            return JointReference(*columns)
        if len(record.names) != len(self._names) or set(record.names) != set(self._names):
            return None
        order = [record.names.index(name) for name in self._names]
        return JointReference(*(column[order] for column in columns))


def joint_motion_limits(profile: Profile, margin: float = 1.0) -> JointMotionLimits:
    """`margin` times the limits of `profile`, in the order of ``robot.arm_joints``."""
    limits, joints = profile.limits.joint, len(profile.robot.arm_joints)
    names = ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return JointMotionLimits(*(margin * np.array(limits.of(name, joints)) for name in names))


def joint_guard_limits(
    profile: Profile, lower_rad: FloatArray, upper_rad: FloatArray
) -> JointGuardLimits:
    """Limits of a profile's joint stream for an arm with joints of this range, (n,) each."""
    return JointGuardLimits(
        profile.timing.command_timeout_s,
        joint_motion_limits(profile, BRAKE_MARGIN),
        lower_rad,
        upper_rad,
    )
