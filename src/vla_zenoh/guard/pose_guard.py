"""The robot's side of the pose stream: what a controller may follow, and what it does in silence.

A stream of poses is only as good as its writer. Between it and the controller stands
`PoseGuard`: it refuses what is not finite, not new, from somebody else, or a jump; between two
commands it extrapolates with the command's own velocity and acceleration; and when the stream falls
silent in motion it brakes by itself, jerk-limited, and says so.
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
from vla_zenoh.types import FloatArray, PoseCommand, Stamped

TURN_STOP, TURN_BESIDE = 0.55, 0.5
"""Parts of a limit of rotation that each axis may have, so that the norm of three keeps it: in a
stop, and beside a motion that turns as well."""


class GuardLimits(NamedTuple):
    """What the robot's side allows.

    Args:
        timeout_s: silence after which it brakes.
        jump_m: a command may differ from the reference in force by this much.
        jump_rad: likewise.
        begin_m: the first command of a stream may differ by this much. A stream begins where the
            reference is; one that goes on after the robot has braked by itself would jerk it.
        begin_rad: likewise.
        begin_m_s: and it may move this fast: a stream of ours begins at rest.
        begin_rad_s: likewise.
        brake: velocity, acceleration and jerk of its own stop.
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
    """Poses; a way beside one is of the position, and of the rotation vector r of ``exp3(r) R``.

    Its rates are exact however large r is, so that the twist of what lies beside a motion is that
    of its poses.
    """

    def rest(self, motion: Motion) -> Motion:
        """Standing where `motion` is."""
        return Motion(motion.pose, _STILL, _STILL)

    def speed(self, motion: Motion) -> GovernedPath:
        """Twist and acceleration."""
        return GovernedPath(_STILL, motion.twist, motion.acceleration)

    def beside(self, base: Motion, way: GovernedPath) -> Motion:
        """See `vla_zenoh.guard.reference_governor.Space`."""
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
        """See `vla_zenoh.guard.reference_governor.Space`."""
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
        """Of translation an axis counts, of rotation the norm."""
        sizes = np.abs(shares)
        sizes[..., 3:] = np.sqrt((shares[..., 3:] ** 2).sum(axis=-1, keepdims=True))
        return sizes


_STILL = np.zeros(6)


class PoseGuard(StreamGuard[Motion]):
    """See the module.

    Args:
        pose: reference at first: where the robot stands.
        dt_s: tick of the controller.
        limits: see `GuardLimits`.
    """

    def __init__(self, pose: Pose, dt_s: float, limits: GuardLimits) -> None:
        self._limits = limits
        super().__init__(
            PoseSpace(), _standing(pose), dt_s, limits.timeout_s, _governed(limits.brake)
        )

    def reset(self, pose: Pose) -> None:
        """The robot was put elsewhere; follow nobody and stand."""
        self.anchor(pose)
        self._stream.forget()

    def anchor(self, pose: Pose) -> None:
        """Somebody else moved the robot; follow nobody and stand. Commands heard stay heard."""
        self._put(_standing(pose))

    def offer(self, command: Stamped[PoseCommand], now_ns: int) -> str | None:
        """Take a command, or say in one word why not.

        Returns:
            None, or ``foreign``, ``replayed``, ``late``, ``braking``, ``jump``, ``too_fast``.
        """
        record = command.record
        objection = self._objection(command.header, command.received_ns)
        if objection is not None:
            return objection
        rotation = rotation_from_quat(record.quat_xyzw)
        here, limits = self._expected.pose, self._limits
        jump_m, jump_rad = (
            (limits.jump_m, limits.jump_rad)
            if self.following
            else (limits.begin_m, limits.begin_rad)
        )
        if (
            norm3(record.position_m - here.position_m) > jump_m
            or angle_between(here.rotation, rotation) > jump_rad
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
        motion = Motion(Pose(record.position_m, rotation), record.twist, record.acceleration)
        self._take(Stamped(command.header, motion, command.received_ns))
        return None


def _standing(pose: Pose) -> Motion:
    position_m = np.array(pose.position_m, dtype=np.float64)
    return Motion(Pose(position_m, np.array(pose.rotation)), _STILL, _STILL)


def _governed(limits: MotionLimits) -> GovernorLimits:
    orders = (
        np.repeat([straight, turning], 3)
        for straight, turning in zip(limits.translation, limits.rotation, strict=True)
    )
    shares = (np.repeat([1.0, share], 3) for share in (TURN_STOP, TURN_BESIDE))
    return GovernorLimits(*orders, *shares)


def guard_limits(profile: Profile) -> GuardLimits:
    """What the robot's side of `profile` allows: its own stop may be harder than the stream."""
    translation, rotation = motion_limits(profile.limits)
    velocity, acceleration, jerk = translation
    spin, spin_change, spin_jerk = rotation
    m = BRAKE_MARGIN
    brake = MotionLimits(
        (m * velocity, m * acceleration, m * jerk), (m * spin, m * spin_change, m * spin_jerk)
    )
    return GuardLimits(profile.timing.command_timeout_s, brake)
