"""The robot's side of the joint stream: what a controller may follow, and what it does in silence.

The same as `vla_zenoh.control.reference` for an arm that is commanded by joint positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import (
    ControlInterface,
    InputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from vla_zenoh.control.correction import Correction
from vla_zenoh.control.joint_impedance import JointReference
from vla_zenoh.control.stream import ACCELERATE_S, BRAKE_MARGIN, CommandStream
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand, Stamped

STILL_RAD_S = 1e-4
"""A stream that ends slower than this has ended on purpose."""

SMOOTHED_RAD, SMOOTHED_RAD_S = 0.002, 0.1
"""A reference that would step by this much, beyond its own motion, goes over instead: see
`vla_zenoh.control.reference`."""


class JointMotionLimits(NamedTuple):
    """(n,) each: rad/s, rad/s^2, rad/s^3."""

    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    jerk_rad_s3: FloatArray


class JointGuardLimits(NamedTuple):
    """What the robot's side allows.

    Args:
        timeout_s: silence after which it brakes.
        brake: of its own stop; a command that is faster is refused.
        lower_rad: (n,) least position of every joint.
        upper_rad: (n,) greatest.
        jump_rad: no joint may be commanded further than this from the reference in force.
        begin_rad: nor this far by the first command of a stream, which begins where the arm stands.
        begin_rad_s: and no joint may move faster than this in it: a stream of ours begins at rest.
    """

    timeout_s: float
    brake: JointMotionLimits
    lower_rad: FloatArray
    upper_rad: FloatArray
    jump_rad: float = 0.05
    begin_rad: float = 0.004
    begin_rad_s: float = 0.1


class JointGuard:
    """See the module.

    Args:
        names: of the arm's joints, in the order of every (n,) here.
        position_rad: reference at first: where the arm stands.
        dt_s: tick of the controller.
        limits: see `JointGuardLimits`.
    """

    def __init__(
        self,
        names: Sequence[str],
        position_rad: FloatArray,
        dt_s: float,
        limits: JointGuardLimits,
    ) -> None:
        self._names = tuple(names)
        self._limits = limits
        self._dt_s = dt_s
        self._stream: CommandStream[JointReference] = CommandStream(limits.timeout_s)
        self._correction = Correction(len(position_rad), dt_s)
        self._brake: Trajectory | None = None
        self._brake_s = 0.0
        self.silences = 0
        self.motion = JointReference.at_rest(position_rad)

    def restart(self, position_rad: FloatArray) -> None:
        """The robot was put elsewhere; follow nobody and stand."""
        self.anchor(position_rad)
        self._stream.forget()

    def anchor(self, position_rad: FloatArray) -> None:
        """Somebody else moved the robot; follow nobody and stand. Commands heard stay heard."""
        self._stream.end()
        self._correction.clear()
        self._brake = None
        self.motion = JointReference.at_rest(position_rad)

    def stand(self) -> None:
        """Follow nobody and stand where the reference is: the arm stopped there by itself."""
        self.anchor(self.motion.position_rad)

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._stream.newest is not None

    @property
    def braking(self) -> bool:
        """The stream fell silent in motion."""
        return self._brake is not None

    def offer(self, command: Stamped[JointCommand], now_ns: int) -> str | None:
        """Take a command, or say in one word why not.

        Returns:
            None, or ``foreign``, ``replayed``, ``late``, ``braking``, ``names`` (not exactly the
            arm's joints), ``jump``, ``too_fast``, ``out_of_range``.
        """
        objection = self._stream.objection(command.header, command.received_ns)
        if objection is not None:
            return objection
        if self.braking:
            return "braking"
        wanted = self._ordered(command.record)
        if wanted is None:
            return "names"
        here, limits = self.motion.position_rad, self._limits
        jump_rad = limits.jump_rad if self.following else limits.begin_rad
        if (np.abs(wanted.position_rad - here) > jump_rad).any():
            return "jump"
        if (np.abs(wanted.velocity_rad_s) > limits.brake.velocity_rad_s).any() or (
            np.abs(wanted.acceleration_rad_s2) > limits.brake.acceleration_rad_s2
        ).any():
            return "too_fast"
        if not self.following and (np.abs(wanted.velocity_rad_s) > limits.begin_rad_s).any():
            return "too_fast"
        # An arm that stands outside its range may come back, and goes no further out.
        if (wanted.position_rad < np.minimum(limits.lower_rad, here)).any() or (
            wanted.position_rad > np.maximum(limits.upper_rad, here)
        ).any():
            return "out_of_range"
        self._stream.take(Stamped(command.header, wanted, command.received_ns))
        return None

    def _ordered(self, record: JointCommand) -> JointReference | None:
        """The command in the arm's own order of joints, None where it is for other joints."""
        columns = (record.position_rad, record.velocity_rad_s, record.acceleration_rad_s2)
        if record.names == self._names:
            return JointReference(*columns)
        if len(record.names) != len(self._names) or set(record.names) != set(self._names):
            return None
        order = [record.names.index(name) for name in self._names]
        return JointReference(*(column[order] for column in columns))

    def tick(self, now_ns: int) -> JointReference:
        """The reference to follow at `now_ns`."""
        command = self._stream.live(now_ns)
        if command is not None:
            self._correction.tick()
            told = self._extrapolate(command, self._stream.ahead_s(now_ns))
            may_step = self._stream.may_step(now_ns, self._dt_s)
            self.motion = self._joined(told) if may_step else self._corrected(told)
            return self.motion
        if self._stream.newest is not None:
            self._end_of_stream()
        if self._brake is None:
            self.motion = JointReference.at_rest(self.motion.position_rad)
            return self.motion
        self._brake_s += self._dt_s
        self.motion = JointReference(*map(np.array, self._brake.at_time(self._brake_s)))
        if self._brake_s >= self._brake.duration:
            self._brake = None
        return self.motion

    def _joined(self, told: JointReference) -> JointReference:
        """What is told, so that it goes on from the reference of the tick before without a step."""
        motion, dt_s, last = self._corrected(told), self._dt_s, self.motion
        velocity = last.velocity_rad_s + last.acceleration_rad_s2 * dt_s
        position = last.position_rad + (last.velocity_rad_s + velocity) * (0.5 * dt_s)
        if (
            float(np.abs(motion.position_rad - position).max()) > SMOOTHED_RAD
            or float(np.abs(motion.velocity_rad_s - velocity).max()) > SMOOTHED_RAD_S
        ):
            self._correction.begin(position - told.position_rad, velocity - told.velocity_rad_s)
            return self._corrected(told)
        return motion

    def _corrected(self, motion: JointReference) -> JointReference:
        rest = self._correction.now
        if rest is None:
            return motion
        return JointReference(
            motion.position_rad + rest.value,
            motion.velocity_rad_s + rest.rate,
            motion.acceleration_rad_s2 + rest.change,
        )

    def _end_of_stream(self) -> None:
        self._stream.end()
        self._correction.clear()
        if float(np.abs(self.motion.velocity_rad_s).max()) < STILL_RAD_S:
            return
        self.silences += 1
        self._brake = stop_from(self.motion, self._limits.brake)
        self._brake_s = 0.0

    @staticmethod
    def _extrapolate(command: JointReference, ahead_s: float) -> JointReference:
        believed_s = min(ahead_s, ACCELERATE_S)
        position_rad, velocity_rad_s, acceleration_rad_s2 = command
        velocity_rad_s = velocity_rad_s + acceleration_rad_s2 * believed_s
        return JointReference(
            position_rad
            + velocity_rad_s * ahead_s
            - acceleration_rad_s2 * (0.5 * believed_s * believed_s),
            velocity_rad_s,
            np.zeros(len(position_rad)) if ahead_s > believed_s else acceleration_rad_s2,
        )


def stop_from(motion: JointReference, limits: JointMotionLimits) -> Trajectory | None:
    """The shortest jerk-limited stop from `motion`, each joint by itself.

    None where none can be planned, which leaves standing at once: finite motions all have one.
    """
    joints = len(motion.position_rad)
    ask, path = InputParameter(joints), Trajectory(joints)
    ask.control_interface = ControlInterface.Velocity
    ask.synchronization = Synchronization.No
    ask.current_position = motion.position_rad.tolist()
    ask.current_velocity = motion.velocity_rad_s.tolist()
    ask.current_acceleration = motion.acceleration_rad_s2.tolist()
    ask.target_velocity = ask.target_acceleration = [0.0] * joints
    ask.max_acceleration = limits.acceleration_rad_s2.tolist()
    ask.max_jerk = limits.jerk_rad_s3.tolist()
    try:
        Ruckig(joints).calculate(ask, path)
    except (RuckigError, ValueError):
        return None
    return path


def joint_motion_limits(profile: Profile, margin: float = 1.0) -> JointMotionLimits:
    """`margin` times the limits of `profile`, in the order of ``robot.arm_joints``."""
    limits, joints = profile.limits.joint, len(profile.robot.arm_joints)
    names = ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return JointMotionLimits(*(margin * np.array(limits.of(name, joints)) for name in names))


def joint_guard_limits(
    profile: Profile, lower_rad: FloatArray, upper_rad: FloatArray
) -> JointGuardLimits:
    """What the robot's side of `profile` allows an arm with joints of this range, (n,) each."""
    return JointGuardLimits(
        profile.timing.command_timeout_s,
        joint_motion_limits(profile, BRAKE_MARGIN),
        lower_rad,
        upper_rad,
    )
