"""Jerk-limited motion to a target pose that may change at any tick: Ruckig on R^3 x SO(3).

Translation is planned in the base frame. Rotation is planned as the rotation vector ``r`` of
``R_anchor^T R``; at every new target the anchor moves to the current smoothed rotation, so ``r``
starts at zero, stays small, never wraps at pi, and velocity and acceleration carry over exactly
(at r = 0, r' is the body velocity and r'' the body acceleration). The motion of these six axes is
that of `vla_zenoh.control.axis_smoothing`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.axis_smoothing import FULL, AxisSmoother, AxisState, Shares
from vla_zenoh.kinematics.so3 import Pose, body_rates, exp3, log3, orthonormal, spatial_rates
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

__all__ = ["FULL", "ROTATION_BOX", "Motion", "MotionLimits", "Shares", "Smoother", "motion_limits"]

ROTATION_BOX = 0.55
"""Share of a rotation limit per axis, so that the norm over three axes (sqrt 3 of it) and the small
terms of a moving chart (5 %) stay below the limit in any direction."""


class MotionLimits(NamedTuple):
    """(velocity, acceleration, jerk): translation per axis in m, s; rotation as norm in rad, s."""

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]


def motion_limits(limits: Limits) -> MotionLimits:
    """The motion limits of a profile."""
    translation, rotation = limits.translation, limits.rotation
    return MotionLimits(
        (translation.velocity_m_s, translation.acceleration_m_s2, translation.jerk_m_s3),
        (rotation.velocity_rad_s, rotation.acceleration_rad_s2, rotation.jerk_rad_s3),
    )


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


class Smoother(AxisSmoother):
    """Trajectory generator: moves to targets within motion limits, or brakes.

    Args:
        pose: initial pose.
        dt_s: duration of a tick.
        limits: of the motion.
        bounds_m: lower and upper corner (3,) of the box to stay in; None: none.
    """

    def __init__(
        self,
        pose: Pose,
        dt_s: float,
        limits: MotionLimits,
        bounds_m: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        box = [
            [translation] * 3 + [rotation * ROTATION_BOX] * 3
            for translation, rotation in zip(*limits, strict=True)
        ]
        self._anchor = np.eye(3)
        super().__init__(np.zeros(6), dt_s, np.array(box), (slice(0, 3), slice(3, 6)))
        self.bounds_m = bounds_m
        self.reset(pose)

    def reset(self, pose: Pose) -> None:
        """Stand at `pose` without any motion; only while nothing is streamed."""
        self._anchor = orthonormal(pose.rotation)
        self._aim = pose
        self.stand(np.array([*pose.position_m, 0.0, 0.0, 0.0]))

    def stand(self, position: FloatArray) -> None:
        super().stand(position)
        pose = Pose(self.state.position[:3], self._anchor)
        self.motion = Motion(pose, np.zeros(6), np.zeros(6))

    def target(self, pose: Pose, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to `pose` from the present state; see `AxisSmoother.move_to`."""
        self._settle(shares)
        self._aim = pose
        target = np.array([*pose.position_m, *log3(self._anchor.T @ pose.rotation)])
        return self._plan_to(target, shares, all_to_stop)

    def _move_again(self, shares: Shares, all_to_stop: bool) -> None:
        self.target(self._aim, shares, all_to_stop=all_to_stop)

    def resting_pose(self) -> Pose:
        """Brake, and return where the brake will end."""
        if self.at_rest:
            return self.motion.pose
        end = self.braked()
        if self._plan is None:
            return self.motion.pose
        return Pose(end[:3], orthonormal(self._anchor @ exp3(end[3:])))

    def way_to(self, pose: Pose) -> FloatArray:
        """(6,) from the smoothed pose to another, m and rad in its own axes."""
        position_m, rotation = self.motion.pose
        return np.concatenate([pose.position_m - position_m, log3(rotation.T @ pose.rotation)])

    def axis_rates(self) -> tuple[FloatArray, FloatArray]:
        """(6,) velocity and acceleration; those of rotation in axes that turn with the arm."""
        (_, rotation), *rates = self.motion
        velocity, change = (np.append(part[:3], rotation.T @ part[3:]) for part in rates)
        return velocity, change

    def brake_from(self, motion: Motion) -> None:
        """Brake from the state of another motion."""
        self.reset(motion.pose)
        body = motion.pose.rotation.T
        (velocity, spin), (change, spin_change) = (
            (values[:3], body @ values[3:]) for values in (motion.twist, motion.acceleration)
        )
        self.state = self.state._replace(
            velocity=np.concatenate([velocity, spin]),
            acceleration=np.concatenate([change, spin_change]),
        )
        self.motion = motion
        self.brake()

    # -- moving -------------------------------------------------------------------------------
    def tick(self, pace: float = 1.0) -> Motion:
        """Advance by one tick.

        Args:
            pace: part of the tick by which the motion advances, for a slow follower. Twist and
                acceleration are those at full pace.
        """
        if not self.advance(pace):
            return self.motion
        position, velocity, acceleration = self.state
        rotation = self._anchor @ exp3(position[3:])
        spin, spin_change = spatial_rates(position[3:], velocity[3:], acceleration[3:])
        twist, change = velocity.copy(), acceleration.copy()
        twist[3:], change[3:] = self._anchor @ spin, self._anchor @ spin_change
        self.motion = Motion(Pose(position[:3].copy(), rotation), twist, change)
        return self.motion

    @property
    def _rates(self) -> tuple[FloatArray, FloatArray]:
        return self.motion[1:]

    def _settle(self, shares: Shares) -> None:
        """Move the anchor to the present rotation, and set noise to zero."""
        position, velocity, acceleration = self.state
        spin, spin_change = body_rates(position[3:], velocity[3:], acceleration[3:])
        self._anchor = orthonormal(self._anchor @ exp3(position[3:]))
        self.state = AxisState(
            np.concatenate([position[:3], np.zeros(3)]),
            np.concatenate([velocity[:3], spin]),
            np.concatenate([acceleration[:3], spin_change]),
        )
        super()._settle(shares)
