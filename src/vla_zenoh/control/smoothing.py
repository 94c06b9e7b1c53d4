"""Jerk-limited motion towards a pose that may change at any tick: Ruckig on R^3 x SO(3).

Translation is planned in the base frame. Rotation is planned as the rotation vector ``r`` of
``R_anchor^T R``; at every new target the anchor moves to the current smoothed rotation, so ``r``
starts at zero, stays small, never wraps at pi, and velocity and acceleration carry over exactly
(at r = 0, r' is the body velocity and r'' the body acceleration).

Ruckig: Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target
states", RSS 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from vla_zenoh.control.so3 import Pose, body_rates, exp3, log3, orthonormal
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

AXES = 6
REST_VELOCITY = 1e-6
"""m/s and rad/s: slower counts as standing."""
REST_OFFSET = 1e-6
"""m and rad: nearer to the target counts as there. Ruckig may end some 1e-9 beside it."""

ROTATION_BOX = 0.55
"""Share of a rotation limit given to each axis, so that the norm over three axes (sqrt 3 of it) and
the small terms of a moving chart (5 %) stay below the limit whatever the direction."""


class MotionLimits(NamedTuple):
    """(velocity, acceleration, jerk): translation per axis in m, s; rotation as norm in rad, s."""

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]


def motion_limits(limits: Limits) -> MotionLimits:
    """The profile's limits of the smoothed motion."""
    translation, rotation = limits.translation, limits.rotation
    return MotionLimits(
        (translation.velocity_m_s, translation.acceleration_m_s2, translation.jerk_m_s3),
        (rotation.velocity_rad_s, rotation.acceleration_rad_s2, rotation.jerk_rad_s3),
    )


class Shares(NamedTuple):
    """Parts of the limits of velocity, acceleration and jerk, each above 0 and at most 1."""

    velocity: float = 1.0
    acceleration: float = 1.0
    jerk: float = 1.0


FULL = Shares()


class Motion(NamedTuple):
    """One point of the smoothed motion, base frame.

    Args:
        pose: position (3,) m, rotation (3, 3).
        twist: (6,) m/s, rad/s.
        acceleration: (6,) m/s^2, rad/s^2.
    """

    pose: Pose
    twist: FloatArray
    acceleration: FloatArray


class Smoother:
    """Follows targets within velocity, acceleration and jerk limits, or brakes.

    Args:
        pose: where it stands at first.
        dt_s: duration of a tick.
        limits: of the motion.
    """

    def __init__(self, pose: Pose, dt_s: float, limits: MotionLimits) -> None:
        self._dt_s = dt_s
        self._otg = Ruckig(AXES, dt_s)
        self._input = InputParameter(AXES)
        self._output = OutputParameter(AXES)
        self.box = np.array([self._box(limits, order) for order in range(3)])
        """(3, 6) limits of velocity, acceleration and jerk of every axis at full shares."""
        self.failures = 0
        self.reset(pose)

    @staticmethod
    def _box(limits: MotionLimits, order: int) -> list[float]:
        return [limits.translation[order]] * 3 + [limits.rotation[order] * ROTATION_BOX] * 3

    def reset(self, pose: Pose) -> None:
        """Stand still at `pose`, forgetting all motion. Only for an arm that is not streamed to."""
        self._anchor = orthonormal(pose.rotation)
        zeros = [0.0] * AXES
        self._otg.reset()
        self._take(FULL)
        self._input.control_interface = ControlInterface.Position
        self._input.synchronization = Synchronization.Phase
        self._input.current_position = [*pose.position_m.tolist(), 0.0, 0.0, 0.0]
        self._input.current_velocity = zeros
        self._input.current_acceleration = zeros
        self._input.target_position = self._input.current_position
        self._input.target_velocity = zeros
        self._input.target_acceleration = zeros
        self.braking = self._under_way = False
        self.motion = Motion(
            Pose(np.array(pose.position_m, dtype=np.float64), self._anchor),
            np.zeros(6),
            np.zeros(6),
        )

    def _take(self, shares: Shares) -> None:
        velocity, acceleration, jerk = (
            [share * limit for limit in row] for share, row in zip(shares, self.box, strict=True)
        )
        self._input.max_velocity = velocity
        self._input.max_acceleration = acceleration
        self._input.max_jerk = jerk

    def target(self, pose: Pose, shares: Shares = FULL) -> None:
        """Head for `pose` from the present state, without a step in velocity or acceleration.

        Args:
            pose: where to.
            shares: of the limits; who is faster slows down within them. More of the jerk is taken
                where the arm would get too fast first, or turn round.
        """
        self._anchor_here()
        self._take(shares._replace(jerk=max(shares.jerk, self._least_jerk())))
        self.braking = False
        self._input.control_interface = ControlInterface.Position
        self._input.synchronization = Synchronization.Phase
        self._input.target_position = [
            *pose.position_m.tolist(),
            *log3(self._anchor.T @ pose.rotation).tolist(),
        ]

    def brake(self, shares: Shares | None = None) -> None:
        """Come to rest as fast as the limits allow, each axis by itself.

        Args:
            shares: of the limits, where not all can be had; all axes then stop together, for what
                bounds them is bound to the direction. More of the jerk is taken where the arm would
                get too fast otherwise. Not looked at while it brakes already.
        """
        if self.braking:
            return
        self._anchor_here()
        self._under_way = False
        shares = shares and shares._replace(jerk=max(shares.jerk, self._least_jerk()))
        self._take(shares or FULL)
        self.braking = True
        self._input.control_interface = ControlInterface.Velocity
        self._input.synchronization = Synchronization.Phase if shares else Synchronization.No

    def _least_jerk(self) -> float:
        """Part of the jerk limits that an acceleration needs to end in time.

        Before its axis is faster than its limit where it speeds up, before that turns round where
        it slows down. With less of it the arm would go on speeding up for a while, to any speed.
        """
        velocity = np.array(self._input.current_velocity)
        acceleration = np.array(self._input.current_acceleration)
        speed = np.abs(velocity)
        room = np.where(velocity * acceleration < 0, speed, self.box[0] - speed)
        needed = acceleration**2 / (2 * np.maximum(room, REST_VELOCITY)) / self.box[2]
        return min(float(needed.max()), 1.0)

    def resting_pose(self) -> Pose:
        """Brake, and foretell where that ends."""
        if self.at_rest:
            return self.motion.pose
        self.brake()
        path = Trajectory(AXES)
        try:
            if self._under_way:
                path = self._output.trajectory  # planned anew from here, axes may stop otherwise
            else:
                Ruckig(AXES).calculate(self._input, path)
            position, _, _ = path.at_time(path.duration)
        except (RuckigError, ValueError):
            return self.motion.pose
        return Pose(
            np.array(position[:3]), orthonormal(self._anchor @ exp3(np.array(position[3:])))
        )

    def brake_from(self, motion: Motion) -> None:
        """Take over a motion that somebody else made, and brake."""
        self.reset(motion.pose)
        body = motion.pose.rotation.T
        self._input.current_velocity = [
            *motion.twist[:3].tolist(),
            *(body @ motion.twist[3:]).tolist(),
        ]
        self._input.current_acceleration = [
            *motion.acceleration[:3].tolist(),
            *(body @ motion.acceleration[3:]).tolist(),
        ]
        self.motion = motion
        self.brake()

    def tick(self, pace: float = 1.0) -> Motion:
        """Advance by one tick.

        Args:
            pace: part of the tick by which the motion goes on: who follows it may be slow. Twist
                and acceleration are those of the motion at its own pace.
        """
        self._otg.delta_time = pace * self._dt_s
        try:
            self._otg.update(self._input, self._output)
        except (RuckigError, ValueError):
            # A failed calculation leaves the old trajectory half overwritten: forget it, and stop.
            self.failures += 1
            self._otg.reset()
            self.braking = False
            self.brake()
            try:
                self._otg.update(self._input, self._output)
            except (RuckigError, ValueError):
                self._otg.reset()
                self.reset(self.motion.pose)
                return self.motion
        self._output.pass_to_input(self._input)
        self._under_way = self.braking
        position = np.array(self._output.new_position)
        velocity = np.array(self._output.new_velocity)
        acceleration = np.array(self._output.new_acceleration)
        spin, spin_change = body_rates(position[3:], velocity[3:], acceleration[3:])
        rotation = self._anchor @ exp3(position[3:])
        velocity[3:] = rotation @ spin
        acceleration[3:] = rotation @ spin_change
        self.motion = Motion(Pose(position[:3], rotation), velocity, acceleration)
        return self.motion

    @property
    def at_rest(self) -> bool:
        """Standing, and not about to start."""
        if float(np.abs(self.motion.twist).max()) > REST_VELOCITY:
            return False
        if self.braking:
            return float(np.abs(self.motion.acceleration).max()) < 1e-3
        ahead = np.array(self._input.target_position) - np.array(self._input.current_position)
        return float(np.abs(ahead).max()) < REST_OFFSET

    def _anchor_here(self) -> None:
        rotvec = np.array(self._input.current_position[3:])
        rate = np.array(self._input.current_velocity[3:])
        change = np.array(self._input.current_acceleration[3:])
        spin, spin_change = body_rates(rotvec, rate, change)
        self._anchor = orthonormal(self._anchor @ exp3(rotvec))
        self._input.current_position = [*self._input.current_position[:3], 0.0, 0.0, 0.0]
        self._input.current_velocity = [*self._input.current_velocity[:3], *spin.tolist()]
        self._input.current_acceleration = [
            *self._input.current_acceleration[:3],
            *spin_change.tolist(),
        ]
