"""The robot's side of the pose stream: what a controller may follow, and what it does in silence.

A stream of poses is only as good as its writer. Between it and the controller stands
`ReferenceGuard`: it refuses what is not finite, not new, from somebody else, or a jump; between two
commands it extrapolates with the command's own velocity and acceleration; and when the stream falls
silent in motion it brakes by itself, jerk-limited, and says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.smoothing import Motion, MotionLimits, Smoother, motion_limits
from vla_zenoh.control.so3 import (
    Pose,
    angle_between,
    exp3,
    norm3,
    orthonormal,
    rotation_from_quat,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import PoseCommand, Stamped

CLOCK_DRIFT = 1e-3
"""Share by which two clocks may drift apart; a real one does by a tenth of that."""
ACCELERATE_S = 0.02
"""For how long a command's acceleration is believed; its velocity is until the stream times out."""
BRAKE_MARGIN = 2.0
"""Its own stop may use this multiple of the stream's limits."""
STILL = 1e-4
"""m/s and rad/s: a stream that ends slower than this has ended on purpose."""


class GuardLimits(NamedTuple):
    """What the robot's side allows.

    Args:
        timeout_s: silence after which it brakes.
        jump_m: a command may differ from the reference in force by this much.
        jump_rad: likewise.
        brake: velocity, acceleration and jerk of its own stop.
    """

    timeout_s: float
    brake: MotionLimits
    jump_m: float = 0.02
    jump_rad: float = 0.1


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
        self._command: Stamped[PoseCommand] | None = None
        self._source: str | None = None
        self._last_seq = -1
        self._base_ns = 0
        self._delay_ns = 0
        self.braking = False
        self.silences = 0
        self.motion = self._smoother.motion

    def restart(self, pose: Pose) -> None:
        """The robot was put elsewhere; follow nobody and stand."""
        self._command, self._source, self._last_seq = None, None, -1
        self.braking = False
        self._smoother.reset(pose)
        self.motion = self._smoother.motion

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._command is not None

    def offer(self, command: Stamped[PoseCommand], now_ns: int) -> str | None:
        """Take a command, or say in one word why not: ``foreign``, ``replayed``, ``jump``."""
        header, record = command.header, command.record
        if self._command is not None and header.source != self._source:
            return "foreign"
        if header.source == self._source and header.seq <= self._last_seq:
            return "replayed"
        if self.braking:
            return "braking"
        rotation = rotation_from_quat(record.quat_xyzw)
        here = self.motion.pose
        if (
            norm3(record.position_m - here.position_m) > self._limits.jump_m
            or angle_between(here.rotation, rotation) > self._limits.jump_rad
        ):
            return "jump"
        for values, order in ((record.twist, 0), (record.acceleration, 1)):
            if float(np.abs(values[:3]).max()) > 2 * self._brake_limits.translation[order]:
                return "too_fast"
            if float(np.linalg.norm(values[3:])) > 2 * self._brake_limits.rotation[order]:
                return "too_fast"
        self._place_in_time(command)
        self._command, self._source, self._last_seq = command, header.source, header.seq
        return None

    def _place_in_time(self, command: Stamped[PoseCommand]) -> None:
        """Put `command` on our clock by its stamp, because arrival times jitter.

        The difference of both clocks is the shortest delay seen: a command that was held up on its
        way is not taken for one that is meant later.
        """
        stamp_ns = command.header.stamp_wall_ns
        delay_ns = command.received_ns - stamp_ns
        if self._command is not None:
            passed_ns = command.received_ns - self._command.received_ns
            shortest_ns = self._delay_ns + int(CLOCK_DRIFT * passed_ns)
            # Later than a stream may be silent: not a hold-up, one of the clocks was set.
            if delay_ns - shortest_ns < self._limits.timeout_s * 1e9:
                delay_ns = min(delay_ns, shortest_ns)
        self._delay_ns = delay_ns
        self._base_ns = stamp_ns + delay_ns

    def tick(self, now_ns: int) -> Motion:
        """The reference to follow at `now_ns`."""
        if self._command is not None:
            silence_s = (now_ns - self._command.received_ns) / 1e9
            if silence_s <= self._limits.timeout_s:
                self.motion = self._extrapolate(self._command.record, now_ns)
                return self.motion
            self._end_of_stream()
        if self.braking:
            self.motion = self._smoother.tick()
            self.braking = not self._smoother.at_rest
            return self.motion
        self.motion = Motion(self.motion.pose, np.zeros(6), np.zeros(6))
        return self.motion

    def _end_of_stream(self) -> None:
        self._command = None
        if float(np.abs(self.motion.twist).max()) < STILL:
            return
        self.silences += 1
        self.braking = True
        self._smoother.brake_from(self.motion)

    def _extrapolate(self, record: PoseCommand, now_ns: int) -> Motion:
        # As far as silence is tolerated: the stream is a function of time, so a late command meets
        # the path its predecessors foretold.
        ahead_s = min(max((now_ns - self._base_ns) / 1e9, 0.0), self._limits.timeout_s)
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
