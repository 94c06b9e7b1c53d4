"""The robot's side of the pose stream: what a controller may follow, and what it does in silence.

A stream of poses is only as good as its writer. Between it and the controller stands
`ReferenceGuard`: it refuses what is not finite, not new, from somebody else, or a jump; between two
commands it extrapolates with the command's own velocity and acceleration; and when the stream falls
silent in motion it brakes by itself, jerk-limited, and says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.correction import Correction
from vla_zenoh.control.smoothing import Motion, MotionLimits, Smoother, motion_limits
from vla_zenoh.control.so3 import (
    Pose,
    angle_between,
    exp3,
    log3,
    norm3,
    orthonormal,
    rotation_from_quat,
)
from vla_zenoh.control.stream import ACCELERATE_S, BRAKE_MARGIN, CommandStream
from vla_zenoh.profile import Profile
from vla_zenoh.types import PoseCommand, Stamped

STILL = 1e-4
"""m/s and rad/s: a stream that ends slower than this has ended on purpose."""


SMOOTHED_M, SMOOTHED_RAD = 0.0005, 0.002
SMOOTHED_M_S, SMOOTHED_RAD_S = 0.03, 0.1
"""A reference that would step by this much, beyond its own motion, goes over instead: a command was
late or lost, the stream began a little aside, or this side itself was woken late."""


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


class ReferenceGuard:
    """See the module.

    Args:
        pose: reference at first: where the robot stands.
        dt_s: tick of the controller.
        limits: see `GuardLimits`.
    """

    def __init__(self, pose: Pose, dt_s: float, limits: GuardLimits) -> None:
        self._limits = limits
        self._dt_s = dt_s
        self._smoother = Smoother(pose, dt_s, limits.brake)
        self._brake_limits = limits.brake
        self._stream: CommandStream[PoseCommand] = CommandStream(limits.timeout_s)
        self._correction = Correction(6, dt_s)
        self.braking = False
        self.silences = 0
        self.motion = self._smoother.motion

    def restart(self, pose: Pose) -> None:
        """The robot was put elsewhere; follow nobody and stand."""
        self.anchor(pose)
        self._stream.forget()

    def anchor(self, pose: Pose) -> None:
        """Somebody else moved the robot; follow nobody and stand. Commands heard stay heard."""
        self._stream.end()
        self._correction.clear()
        self.braking = False
        self._smoother.reset(pose)
        self.motion = self._smoother.motion

    def stand(self) -> None:
        """Follow nobody and stand where the reference is: the arm stopped there by itself."""
        self.anchor(self.motion.pose)

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._stream.newest is not None

    def offer(self, command: Stamped[PoseCommand], now_ns: int) -> str | None:
        """Take a command, or say in one word why not.

        Returns:
            None, or ``foreign``, ``replayed``, ``late``, ``braking``, ``jump``, ``too_fast``.
        """
        record = command.record
        objection = self._stream.objection(command.header, command.received_ns)
        if objection is not None:
            return objection
        if self.braking:
            return "braking"
        rotation = rotation_from_quat(record.quat_xyzw)
        here, limits = self.motion.pose, self._limits
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
            if float(np.abs(values[:3]).max()) > self._brake_limits.translation[order]:
                return "too_fast"
            if float(np.linalg.norm(values[3:])) > self._brake_limits.rotation[order]:
                return "too_fast"
        if not self.following and (
            norm3(record.twist[:3]) > limits.begin_m_s
            or norm3(record.twist[3:]) > limits.begin_rad_s
        ):
            return "too_fast"
        self._stream.take(command)
        return None

    def tick(self, now_ns: int) -> Motion:
        """The reference to follow at `now_ns`."""
        command = self._stream.live(now_ns)
        if command is not None:
            self._correction.tick()
            told = self._extrapolate(command, now_ns)
            may_step = self._stream.may_step(now_ns, self._dt_s)
            self.motion = self._joined(told) if may_step else self._corrected(told)
            return self.motion
        if self._stream.newest is not None:
            self._end_of_stream()
        if self.braking:
            self.motion = self._smoother.tick()
            self.braking = not self._smoother.at_rest
            return self.motion
        self.motion = Motion(self.motion.pose, np.zeros(6), np.zeros(6))
        return self.motion

    def _joined(self, told: Motion) -> Motion:
        """What is told, so that it goes on from the reference of the tick before without a step."""
        motion, dt_s, last = self._corrected(told), self._dt_s, self.motion
        twist = last.twist + last.acceleration * dt_s
        way = (last.twist + twist) * (0.5 * dt_s)
        position_m = last.pose.position_m + way[:3]
        rotation = exp3(way[3:]) @ last.pose.rotation
        if (
            norm3(motion.pose.position_m - position_m) <= SMOOTHED_M
            and angle_between(motion.pose.rotation, rotation) <= SMOOTHED_RAD
            and norm3(motion.twist[:3] - twist[:3]) <= SMOOTHED_M_S
            and norm3(motion.twist[3:] - twist[3:]) <= SMOOTHED_RAD_S
        ):
            return motion
        apart_m = position_m - told.pose.position_m
        turned = log3(rotation @ told.pose.rotation.T)
        self._correction.begin(np.concatenate([apart_m, turned]), twist - told.twist)
        return self._corrected(told)

    def _corrected(self, motion: Motion) -> Motion:
        rest = self._correction.now
        if rest is None:
            return motion
        return Motion(
            Pose(
                motion.pose.position_m + rest.value[:3],
                orthonormal(exp3(rest.value[3:]) @ motion.pose.rotation),
            ),
            motion.twist + rest.rate,
            motion.acceleration + rest.change,
        )

    def _end_of_stream(self) -> None:
        self._stream.end()
        self._correction.clear()
        if float(np.abs(self.motion.twist).max()) < STILL:
            return
        self.silences += 1
        self.braking = True
        self._smoother.brake_from(self.motion)

    def _extrapolate(self, record: PoseCommand, now_ns: int) -> Motion:
        ahead_s = self._stream.ahead_s(now_ns)
        believed_s = min(ahead_s, ACCELERATE_S)
        twist = record.twist + record.acceleration * believed_s
        step = twist * ahead_s - record.acceleration * (0.5 * believed_s * believed_s)
        still = ahead_s > believed_s
        rotation = rotation_from_quat(record.quat_xyzw)
        return Motion(
            Pose(record.position_m + step[:3], orthonormal(exp3(step[3:]) @ rotation)),
            twist,
            np.zeros(6) if still else record.acceleration,
        )


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
