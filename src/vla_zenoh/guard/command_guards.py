"""Guards of the streams of TCP poses and of joint positions: which commands each admits.

What both have in common is in `vla_zenoh.guard.stream_guard`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.limits import JointMotionLimits
from vla_zenoh.control.smoothing import Motion, MotionLimits, motion_limits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN, GovernedPath, GovernorLimits
from vla_zenoh.guard.stream_guard import StreamGuard
from vla_zenoh.kinematics.so3 import (
    Pose,
    angle_between,
    cross3,
    exp3,
    log3,
    norm3,
    rates_of,
    rotation_from_quat,
    spatial_rates,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand, JointReference, PoseCommand

TURN_STOP, TURN_BESIDE = 0.55, 0.5
"""Share of a rotation limit for each axis, so that the norm of three stays within it: in a stop,
and in an offset from a motion that rotates as well."""
_STILL = np.zeros(6)


# -- poses ------------------------------------------------------------------------------------
class GuardLimits(NamedTuple):
    """Limits of a pose stream on the robot's side.

    Args:
        timeout_s: silence after which the guard brakes.
        brake: velocity, acceleration and jerk of its own stop; faster commands are rejected.
        jump_m, jump_rad: a command may be this far from the reference in force.
        begin_m, begin_rad: the first command of a stream may be this far from the reference. A
            stream that goes on after the robot has braked by itself would make it jerk.
        begin_m_s, begin_rad_s: and it may move this fast: our streams begin at rest.
    """

    timeout_s: float
    brake: MotionLimits
    jump_m: float = 0.02
    jump_rad: float = 0.1
    begin_m: float = 0.002
    begin_rad: float = 0.01
    begin_m_s: float = 0.03
    begin_rad_s: float = 0.1


class PoseSpace:
    """Space of TCP poses. An offset is a translation and the vector r of ``exp3(r) R``.

    Rates are exact however large r is: the twist of a motion at an offset is that of its poses.
    """

    def rest(self, motion: Motion) -> Motion:
        return Motion(motion.pose, _STILL, _STILL)

    def speed(self, motion: Motion) -> GovernedPath:
        return GovernedPath(_STILL, motion.twist, motion.acceleration)

    def beside(self, base: Motion, way: GovernedPath) -> Motion:
        turn = exp3(way.value[3:])
        spin, spin_change = spatial_rates(way.value[3:], way.rate[3:], way.change[3:])
        twist, acceleration = base.twist + way.rate, base.acceleration + way.change
        if base.twist is not _STILL:
            carried = turn @ base.twist[3:]
            spin_change += turn @ base.acceleration[3:] + cross3(spin, carried)
            spin += carried
        twist[3:], acceleration[3:] = spin, spin_change
        pose = Pose(base.pose.position_m + way.value[:3], turn @ base.pose.rotation)
        return Motion(pose, twist, acceleration)

    def apart(self, motion: Motion, base: Motion) -> GovernedPath:
        turn = motion.pose.rotation @ base.pose.rotation.T
        rotvec = log3(turn)
        carried = turn @ base.twist[3:]
        spin = motion.twist[3:] - carried
        spin_change = motion.acceleration[3:] - turn @ base.acceleration[3:] - cross3(spin, carried)
        rate, change = motion.twist - base.twist, motion.acceleration - base.acceleration
        rate[3:], change[3:] = rates_of(rotvec, spin, spin_change)
        value = np.concatenate([motion.pose.position_m - base.pose.position_m, rotvec])
        return GovernedPath(value, rate, change)

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Translation counts per axis, rotation by its norm."""
        sizes = np.abs(shares)
        sizes[..., 3:] = np.sqrt((shares[..., 3:] ** 2).sum(axis=-1, keepdims=True))
        return sizes


class PoseGuard(StreamGuard[Motion]):
    """Guard of a stream of TCP poses; `pose` is where the robot stands, `dt_s` one period."""

    def __init__(self, pose: Pose, dt_s: float, limits: GuardLimits) -> None:
        self._limits = limits
        orders = (np.repeat(pair, 3) for pair in zip(*limits.brake, strict=True))
        shares = (np.repeat([1.0, share], 3) for share in (TURN_STOP, TURN_BESIDE))
        brake = GovernorLimits(*orders, *shares)
        super().__init__(PoseSpace(), pose, dt_s, limits.timeout_s, brake)

    def _standing(self, here: Pose) -> Motion:
        position_m = np.array(here.position_m, dtype=np.float64)
        return Motion(Pose(position_m, np.array(here.rotation)), _STILL, _STILL)

    def _admit(self, record: PoseCommand) -> Motion | str:
        rotation = rotation_from_quat(record.quat_xyzw)
        expected, limits = self._expected.pose, self._limits
        jump_m, jump_rad = (
            (limits.jump_m, limits.jump_rad)
            if self.following
            else (limits.begin_m, limits.begin_rad)
        )
        if (
            norm3(record.position_m - expected.position_m) > jump_m
            or angle_between(expected.rotation, rotation) > jump_rad
        ):
            return "jump"
        for values, order in ((record.twist, 0), (record.acceleration, 1)):
            if float(np.abs(values[:3]).max()) > limits.brake.translation[order]:
                return "too_fast"
            if float(np.linalg.norm(values[3:])) > limits.brake.rotation[order]:
                return "too_fast"
        if not self.following and (
            norm3(record.twist[:3]) > limits.begin_m_s
            or norm3(record.twist[3:]) > limits.begin_rad_s
        ):
            return "too_fast"
        return Motion(Pose(record.position_m, rotation), record.twist, record.acceleration)


def guard_limits(profile: Profile) -> GuardLimits:
    """Limits of a profile's pose stream; the robot's own stop may be harder than the stream."""
    (v, a, j), (spin_v, spin_a, spin_j) = motion_limits(profile.limits)
    m = BRAKE_MARGIN
    brake = MotionLimits((m * v, m * a, m * j), (m * spin_v, m * spin_a, m * spin_j))
    return GuardLimits(profile.timing.command_timeout_s, brake)


# -- joint positions --------------------------------------------------------------------------
class JointGuardLimits(NamedTuple):
    """Limits of a joint stream on the robot's side.

    Args:
        timeout_s: silence after which the guard brakes.
        brake: of its own stop; faster commands are rejected.
        lower_rad, upper_rad: (n,) ends of the joint ranges.
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
        return JointReference.at_rest(motion.position_rad)

    def speed(self, motion: JointReference) -> GovernedPath:
        _, velocity_rad_s, acceleration_rad_s2 = motion
        return GovernedPath(np.zeros(len(velocity_rad_s)), velocity_rad_s, acceleration_rad_s2)

    def beside(self, base: JointReference, way: GovernedPath) -> JointReference:
        return JointReference(base[0] + way[0], base[1] + way[1], base[2] + way[2])

    def apart(self, motion: JointReference, base: JointReference) -> GovernedPath:
        return GovernedPath(motion[0] - base[0], motion[1] - base[1], motion[2] - base[2])

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Every joint counts by itself."""
        return np.abs(shares)


class JointGuard(StreamGuard[JointReference]):
    """Guard of a stream of joint positions, which `names` has in the order of every (n,) here."""

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
        wanted = JointReference(
            record.position_rad, record.velocity_rad_s, record.acceleration_rad_s2
        )
        if record.names != self._names:
            if sorted(record.names) != sorted(self._names):
                return "names"
            order = [record.names.index(name) for name in self._names]
            wanted = JointReference(*(column[order] for column in wanted))
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


def joint_motion_limits(profile: Profile, margin: float = 1.0) -> JointMotionLimits:
    """`margin` times the limits of `profile`, in the order of ``robot.arm_joints``."""
    limits, joints = profile.limits.joint, len(profile.robot.arm_joints)
    names = ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return JointMotionLimits(*(margin * np.array(limits.of(name, joints)) for name in names))


def joint_guard_limits(
    profile: Profile, lower_rad: FloatArray, upper_rad: FloatArray
) -> JointGuardLimits:
    """Limits of a profile's joint stream for an arm with joints of this range, (n,) each."""
    brake = joint_motion_limits(profile, BRAKE_MARGIN)
    return JointGuardLimits(profile.timing.command_timeout_s, brake, lower_rad, upper_rad)
