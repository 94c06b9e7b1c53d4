"""The robot's side of the joint stream: what a controller may follow, and what it does in silence.

The same as `vla_zenoh.guard.pose_guard` for an arm that is commanded by joint positions.
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

from vla_zenoh.control.limits import JointMotionLimits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN, GovernedPath, GovernorLimits
from vla_zenoh.guard.stream_guard import StreamGuard
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand, Stamped
from vla_zenoh.types.commands import JointReference


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


class JointSpace:
    """Joint positions (n,); a way beside one is their difference."""

    def rest(self, motion: JointReference) -> JointReference:
        """Standing where `motion` is."""
        return JointReference.at_rest(motion.position_rad)

    def speed(self, motion: JointReference) -> GovernedPath:
        """Velocity and acceleration."""
        _, velocity_rad_s, acceleration_rad_s2 = motion
        return GovernedPath(np.zeros(len(velocity_rad_s)), velocity_rad_s, acceleration_rad_s2)

    def beside(self, base: JointReference, way: GovernedPath) -> JointReference:
        """See `vla_zenoh.guard.reference_governor.Space`."""
        return JointReference(base[0] + way[0], base[1] + way[1], base[2] + way[2])

    def apart(self, motion: JointReference, base: JointReference) -> GovernedPath:
        """See `vla_zenoh.guard.reference_governor.Space`."""
        return GovernedPath(motion[0] - base[0], motion[1] - base[1], motion[2] - base[2])

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Every joint counts."""
        return np.abs(shares)


class JointGuard(StreamGuard[JointReference]):
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
        still = JointReference.at_rest(position_rad)
        whole = np.ones(len(position_rad))
        brake = GovernorLimits(*limits.brake, axis=whole, beside=whole)
        super().__init__(JointSpace(), still, dt_s, limits.timeout_s, brake)

    def reset(self, position_rad: FloatArray) -> None:
        """The robot was put elsewhere; follow nobody and stand."""
        self.anchor(position_rad)
        self._stream.forget()

    def anchor(self, position_rad: FloatArray) -> None:
        """Somebody else moved the robot; follow nobody and stand. Commands heard stay heard."""
        self._put(JointReference.at_rest(position_rad))

    def offer(self, command: Stamped[JointCommand], now_ns: int) -> str | None:
        """Take a command, or say in one word why not.

        Returns:
            None, or ``foreign``, ``replayed``, ``late``, ``braking``, ``names`` (not exactly the
            arm's joints), ``jump``, ``too_fast``, ``out_of_range``.
        """
        objection = self._objection(command.header, command.received_ns)
        if objection is not None:
            return objection
        wanted = self._ordered(command.record)
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
        # An arm that stands outside its range may come back, and goes no further out.
        if (wanted.position_rad < np.minimum(limits.lower_rad, here)).any() or (
            wanted.position_rad > np.maximum(limits.upper_rad, here)
        ).any():
            return "out_of_range"
        self._take(Stamped(command.header, wanted, command.received_ns))
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
