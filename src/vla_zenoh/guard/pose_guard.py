"""Guard of a stream of TCP poses on the robot's side.

It rejects poses that are not new, come from a second source, or jump; between two commands it
extrapolates; when the stream falls silent in motion it brakes, jerk-limited.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
from vla_zenoh.types import FloatArray, PoseCommand

TURN_STOP, TURN_BESIDE = 0.55, 0.5
"""Share of a rotation limit for each axis, so that the norm of three stays within it: in a stop,
and in an offset from a motion that rotates as well."""


class GuardLimits(NamedTuple):
    """Limits of a pose stream on the robot's side.

    Args:
        timeout_s: silence after which the guard brakes.
        brake: velocity, acceleration and jerk of its own stop; faster commands are rejected.
        jump_m: a command may be this far from the reference in force.
        jump_rad: the same for rotation.
        begin_m: the first command of a stream may be this far from the reference. A stream that
            goes on after the robot has braked by itself would make it jerk.
        begin_rad: the same for rotation.
        begin_m_s: and it may move this fast: our streams begin at rest.
        begin_rad_s: the same for rotation.
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
        """At rest at the pose of `motion`."""
        return Motion(motion.pose, _STILL, _STILL)

    def speed(self, motion: Motion) -> GovernedPath:
        """Twist and acceleration."""
        return GovernedPath(_STILL, motion.twist, motion.acceleration)

    def beside(self, base: Motion, way: GovernedPath) -> Motion:
        """The motion at the offset `way` from `base`."""
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
        """The offset of `motion` from `base`."""
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


_STILL = np.zeros(6)


class PoseGuard(StreamGuard[Motion]):
    """Guard of a stream of TCP poses.

    Args:
        pose: where the robot stands.
        dt_s: period of the controller.
        limits: of the stream.
    """

    def __init__(self, pose: Pose, dt_s: float, limits: GuardLimits) -> None:
        self._limits = limits
        super().__init__(PoseSpace(), pose, dt_s, limits.timeout_s, _governed(limits.brake))

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


def _governed(limits: MotionLimits) -> GovernorLimits:
    orders = (
        np.repeat([straight, turning], 3)
        for straight, turning in zip(limits.translation, limits.rotation, strict=True)
    )
    shares = (np.repeat([1.0, share], 3) for share in (TURN_STOP, TURN_BESIDE))
    return GovernorLimits(*orders, *shares)


def guard_limits(profile: Profile) -> GuardLimits:
    """Limits of a profile's pose stream; the robot's own stop may be harder than the stream."""
    translation, rotation = motion_limits(profile.limits)
    velocity, acceleration, jerk = translation
    spin, spin_change, spin_jerk = rotation
    m = BRAKE_MARGIN
    brake = MotionLimits(
        (m * velocity, m * acceleration, m * jerk), (m * spin, m * spin_change, m * spin_jerk)
    )
    return GuardLimits(profile.timing.command_timeout_s, brake)
