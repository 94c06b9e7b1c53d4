"""Jerk-limited motion to a target pose that may change at any tick: Ruckig on R^3 x SO(3).

Translation is planned in the base frame. Rotation is planned as the rotation vector ``r`` of
``R_anchor^T R``; at every new target the anchor moves to the current smoothed rotation, so ``r``
starts at zero, stays small, never wraps at pi, and velocity and acceleration carry over exactly
(at r = 0, r' is the body velocity and r'' the body acceleration).

A motion that is already on the straight line to its target, or stands, is planned as one degree of
freedom along that line: it stays on it whatever the limits become. The same holds for translation
or rotation alone, if the motion beside the line is small: that gets degrees of freedom of its own.
Any other motion has one per axis. Those along the line, or of all axes, are synchronised in time.

Ruckig finds profiles of a given duration by root finding with a precision of 1e-8. An axis that
stands at its target with rounding noise (a velocity of 1e-16), while another axis takes long, can
get a profile that leaves at full jerk and comes back. So values that Ruckig cannot tell from zero
are set to zero before planning, and a plan in which an axis leaves the range between its start, its
target and its stop is replaced by one in which each axis moves as fast as it can.

Ruckig: Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target
states", RSS 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruckig import (
    ControlInterface,
    InputParameter,
    Result,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from vla_zenoh.kinematics.so3 import Pose, body_rates, cross3, exp3, log3, norm3, orthonormal
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

AXES = 6
TRANSLATION, ROTATION = slice(0, 3), slice(3, 6)
REST_VELOCITY = 1e-6
"""m/s and rad/s: slower counts as at rest."""
REST_OFFSET = 1e-6
"""m and rad: nearer to the target counts as reached. Ruckig may end some 1e-9 off."""

QUIET = (1e-8, 1e-8, 1e-6)
"""m or rad, per s, per s^2: smaller values are noise and set to zero. The first two are the
precision of Ruckig's solver; such an acceleration changes a velocity by less in a tick. Of a motion
that is slower by a factor, the last two are smaller by it and its square: see
`Smoother._pace_of`."""
OVERSHOOT = 1e-6
"""m and rad: rounding by which a plan may leave the range between start, target and stop."""

ASIDE = 2e-7
"""m and rad: a target nearer to the line of the motion is on it; goals are float32, 30 nm off."""
BESIDE = 0.01
"""Part of the limits for motion beside the line."""
_ASIDE = np.array([[ASIDE], *([quiet] for quiet in QUIET[1:])])
TINY, MOST = 1e-12, 1e9
_WAYS = (
    (Synchronization.Time, False),
    (Synchronization.No, False),
    (Synchronization.No, True),
)
"""Of planning a motion, in this order: how axes are synchronised, and `slowly` of `_input`."""

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


class Shares(NamedTuple):
    """Shares of the limits of velocity, acceleration and jerk, each above 0 and at most 1."""

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


class _State(NamedTuple):
    """(6,) position, velocity and acceleration of all axes, in the chart of the anchor."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class _Plan:
    """A planned motion: a path in k coordinates along the columns of a basis.

    Args:
        start: (6,) its start.
        basis: (6, k).
        path: of the k coordinates, which start at zero.
        pace: time of the path per second.
    """

    def __init__(
        self, start: FloatArray, basis: FloatArray, path: Trajectory, pace: float = 1.0
    ) -> None:
        self._start, self._basis, self._path, self._pace = start, basis, path, pace
        self.duration_s: float = path.duration / pace
        self.end = start + basis @ path.at_time(path.duration)[0]
        """(6,) its end."""

    def range_m(self) -> tuple[FloatArray, FloatArray]:
        """Bounds (3,) below and above the translation along each axis."""
        low, high = _extrema(self._path)
        basis = self._basis[:3]
        reached = np.stack([basis * low, basis * high])
        start = self._start[:3]
        return start + reached.min(axis=0).sum(axis=1), start + reached.max(axis=0).sum(axis=1)

    def at(self, time_s: float) -> _State:
        """State `time_s` after the start."""
        if time_s >= self.duration_s:
            return _State(self.end, np.zeros(AXES), np.zeros(AXES))
        pace, basis = self._pace, self._basis
        position, velocity, acceleration = self._path.at_time(time_s * pace)
        return _State(
            self._start + basis @ position,
            pace * (basis @ velocity),
            pace * pace * (basis @ acceleration),
        )


class Smoother:
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
        self._dt_s, self.bounds_m = dt_s, bounds_m
        self._ruckigs: dict[int, Ruckig] = {}
        self.box = np.array([self._box(limits, order) for order in range(3)])
        """(3, 6) limits of velocity, acceleration and jerk of every axis at full shares."""
        self.failures = 0
        self.reset(pose)

    @staticmethod
    def _box(limits: MotionLimits, order: int) -> list[float]:
        return [limits.translation[order]] * 3 + [limits.rotation[order] * ROTATION_BOX] * 3

    def reset(self, pose: Pose) -> None:
        """Stand at `pose` without any motion; only while nothing is streamed."""
        self._anchor = orthonormal(pose.rotation)
        zeros = np.zeros(AXES)
        self._state = _State(np.array([*pose.position_m, 0.0, 0.0, 0.0]), zeros, zeros)
        self._target = self._state.position
        self._plan: _Plan | None = None
        self._elapsed_s = 0.0
        self._jerk, self._sign = zeros, zeros
        self._pace = 1.0
        self._slowing_to: tuple[Pose, Shares, bool] | None = None
        self._too_fast = zeros > 0.0
        self.braking = False
        self.motion = Motion(
            Pose(np.array(pose.position_m, dtype=np.float64), self._anchor),
            np.zeros(6),
            np.zeros(6),
        )

    def target(self, pose: Pose, shares: Shares = FULL, *, all_to_stop: bool = False) -> bool:
        """Move to `pose` from the present state, without a step in velocity or acceleration.

        Args:
            pose: the target.
            shares: of the limits; a faster motion slows down within them. More jerk is used if the
                arm would otherwise exceed the velocity limit first, or reverse.
            all_to_stop: use all of acceleration and jerk if the shares do not suffice to stop at
                `pose`. To stay in the box they are used in any case.

        Returns:
            whether the shares suffice.
        """
        self._pace = shares.jerk ** (1 / 3)
        self._anchor_here()
        self.braking = False
        self._target = np.array([*pose.position_m, *log3(self._anchor.T @ pose.rotation)])
        limits, unreversed = self._limits(shares)
        way = self._target - self._state.position
        way[np.abs(way) < QUIET[0]] = 0.0
        plan, enough = self._towards(way, limits, unreversed, all_to_stop)
        self._begin(plan)
        self._too_fast = self._slows() & (np.abs(self._state.velocity) > limits[0])
        again = self._too_fast.any() and not self.braking
        self._slowing_to = (pose, shares, all_to_stop) if again else None
        return enough

    def brake(self, shares: Shares | None = None) -> None:
        """Come to rest as fast as the limits allow, each axis by itself.

        Args:
            shares: of the limits; all axes then stop together, because the shares hold for the
                present direction. More jerk is used if the arm would otherwise exceed the velocity
                limit. Ignored while it brakes already.
        """
        if self.braking:
            return
        self._slowing_to, self._pace = None, 1.0
        self._anchor_here()
        limits = self.box
        if shares is not None:
            _, limits = self._limits(shares)
        self.braking = True
        self._begin(self._stop(limits, together=shares is not None))

    # -- planning -----------------------------------------------------------------------------
    def _begin(self, plan: _Plan | None) -> None:
        """Execute `plan`; without one brake, and if that cannot be planned, stand."""
        self._elapsed_s = 0.0
        if plan is None:
            self.failures += 1
            self.braking = True
            plan = self._stop(self.box, together=False)
        if plan is None:
            self.reset(self.motion.pose)
            return
        self._plan = plan

    def _towards(
        self, way: FloatArray, limits: FloatArray, unreversed: FloatArray, all_to_stop: bool
    ) -> tuple[_Plan | None, bool]:
        """The plan of a motion by `way` (6,) without detours, and whether `limits` suffice.

        Args:
            way: of the motion.
            limits: (3, 6) to keep to.
            unreversed: (3, 6) to keep to where an axis would else reverse for nothing.
            all_to_stop: see `target`.
        """
        if not np.isfinite(way).all():
            return None, False
        basis, parts = self._coordinates(way, limits)
        plan: _Plan | None = None
        hardest = np.concatenate([limits[:1], self.box[1:]])
        attempts = [limits]
        attempts += [unreversed] * bool((limits < unreversed).any())
        attempts += [hardest] * bool((unreversed < hardest).any())
        for most in attempts:
            may_take = hardest if all_to_stop or most is hardest else unreversed
            for synchronization, slowly in _WAYS:
                ask = self._input(basis, most, parts, slowly=slowly)
                ask.target_position = (basis.T @ way).tolist()
                # Motion beside the line ends as soon as it can, independent of the others.
                ask.per_dof_synchronization = [
                    Synchronization.No if part == BESIDE else synchronization for part in parts
                ]
                path = self._calculated(ask)
                if path is None:
                    continue
                found = _Plan(self._state.position, basis, path, self._pace_of(most))
                overshoots = self._overshoots(path, basis.T @ way, (basis, may_take, parts))
                if not overshoots and not self._leaves(found):
                    if most is not limits:
                        self._jerk = most[2] / self.box[2]
                    return found, most is not hardest
                plan = plan if slowly and plan is not None else found
        return plan, False

    def _leaves(self, plan: _Plan) -> bool:
        """Whether a planned motion leaves the box; from outside it may enter."""
        if self.bounds_m is None:
            return False
        low, high = self.bounds_m
        start, end = self._state.position[:3], plan.end[:3]
        inside = (
            np.minimum(start, end) >= low - OVERSHOOT,
            np.maximum(start, end) <= high + OVERSHOOT,
        )
        least, most = plan.range_m()
        return bool(
            (inside[0] & (least < low - OVERSHOOT)).any()
            or (inside[1] & (most > high + OVERSHOOT)).any()
        )

    def _coordinates(self, way: FloatArray, limits: FloatArray) -> tuple[FloatArray, list[float]]:
        """Basis (6, k) with the fewest directions for a motion by `way`, and their limit shares.

        One, if the motion is already along `way`. Otherwise those of translation and rotation: the
        line and two directions beside it if the motion there is small, or the axes.
        """
        _, velocity, acceleration = self._state
        whole = _line(way, velocity, acceleration, self._pace)
        if whole is not None:
            return whole[:, None], [1.0]
        columns: list[FloatArray] = []
        parts: list[float] = []
        for axes in (TRANSLATION, ROTATION):
            found, shares = self._directions(way[axes], limits[:, axes], axes)
            columns.append(np.zeros((AXES, len(shares))))
            columns[-1][axes] = found
            parts += shares
        return np.concatenate(columns, axis=1), parts

    def _directions(
        self, way: FloatArray, limits: FloatArray, axes: slice
    ) -> tuple[FloatArray, list[float]]:
        """The same for three axes: (3, k), with `way` (3,) and `limits` (3, 3)."""
        motion = np.array([self._state.velocity[axes], self._state.acceleration[axes]])
        line = _line(way, motion[0], motion[1], self._pace)
        if line is not None:
            return (line[:, None], [1.0]) if line.any() else (np.zeros((3, 0)), [])
        length = norm3(way)
        if length == 0.0:
            return np.eye(3), [1.0] * 3
        along = way / length
        beside = motion - np.outer(motion @ along, along)
        least = np.eye(3)[int(np.argmin(np.abs(along)))]
        across = cross3(along, least)
        across /= norm3(across)
        others = np.stack([across, cross3(along, across)])
        with np.errstate(divide="ignore"):
            most = BESIDE * (limits[:, None, :] / np.abs(others)).min(axis=2)
        # Its greatest speed once its acceleration has ended, and its distance until it stops.
        fast, change = np.abs(beside @ others.T)
        fast = fast + change**2 / (2 * most[2])
        goes = fast * np.sqrt(fast / most[2]) + fast**2 / most[1]
        if (goes < OVERSHOOT).all() and (fast < most[0]).all() and (change < most[1]).all():
            return np.stack([along, *others], axis=1), [1.0 - 2 * BESIDE, BESIDE, BESIDE]
        return np.eye(3), [1.0] * 3

    def _overshoots(
        self,
        path: Trajectory,
        target: FloatArray,
        stop: tuple[FloatArray, FloatArray, list[float]],
    ) -> bool:
        """Whether a coordinate leaves the range between its start, its target and its stop.

        Args:
            path: the plan.
            target: (k,).
            stop: basis, limits and parts of the stop, see `_input`.
        """
        least, most = np.minimum(target, 0.0) - OVERSHOOT, np.maximum(target, 0.0) + OVERSHOOT
        low, high = _extrema(path)
        if (low >= least).all() and (high <= most).all():
            return False
        ask = self._input(*stop)
        ask.control_interface = ControlInterface.Velocity
        ask.synchronization = Synchronization.No
        stopped = self._calculated(ask)
        if stopped is None:
            return True
        stop_low, stop_high = _extrema(stopped)
        return bool(
            (low < np.minimum(least, stop_low - OVERSHOOT)).any()
            or (high > np.maximum(most, stop_high + OVERSHOOT)).any()
        )

    def _stop(self, limits: FloatArray, *, together: bool) -> _Plan | None:
        basis = np.eye(AXES)
        ask = self._input(basis, limits, [1.0] * AXES)
        ask.control_interface = ControlInterface.Velocity
        for synchronization in [Synchronization.Phase] * together + [Synchronization.No]:
            ask.synchronization = synchronization
            path = self._calculated(ask)
            if path is not None:
                return _Plan(self._state.position, basis, path, self._pace_of(limits))
        return None

    def _input(
        self, basis: FloatArray, limits: FloatArray, parts: list[float], *, slowly: bool = False
    ) -> InputParameter:
        """Ruckig's input along the columns of `basis` (6, k), each with its part of the limits.

        Args:
            basis: of the motion.
            limits: (3, 6) of the axes.
            parts: of the limits, for each column.
            slowly: what is too fast brakes so that it does not fall below half its velocity limit.
                With all of its acceleration it would have to reverse before that has ended.
        """
        _, velocity, acceleration = self._state
        paces = self._pace_of(limits) ** np.array([1.0, 2.0, 3.0])
        with np.errstate(divide="ignore"):
            along = (limits[:, :, None] / np.abs(basis)).min(axis=1) * np.array(parts)
            # On a line the axis that needs most jerk decides: the others have to stay with it.
            most = (limits[2] / self.box[2])[:, None] * (basis != 0.0)
            jerk = (self.box[2][:, None] / np.abs(basis)).min(axis=0)
            jerk *= np.maximum(most.max(axis=0), TINY)
        along[2] = jerk * parts
        along /= paces[:, None]
        velocity, acceleration = velocity @ basis / paces[0], acceleration @ basis / paces[1]
        velocity[np.abs(velocity) < QUIET[1]] = 0.0
        acceleration[np.abs(acceleration) < QUIET[2]] = 0.0
        # Slowing down, and slow enough once that ends: braking harder would reverse the motion.
        speed = np.abs(velocity)
        slows = velocity * acceleration < 0
        after = speed - acceleration**2 / (2 * along[2])
        along[0] = np.where(slows & (after <= along[0]), np.maximum(speed, along[0]), along[0])
        if slowly:
            most = np.minimum(along[1], np.sqrt(along[2] * along[0]))
            along[1] = np.where(speed > along[0], most, along[1])
        ask = InputParameter(len(parts))
        ask.current_position = [0.0] * len(parts)
        ask.current_velocity, ask.current_acceleration = velocity.tolist(), acceleration.tolist()
        ask.max_velocity, ask.max_acceleration, ask.max_jerk = np.minimum(along, MOST).tolist()
        return ask

    def _calculated(self, ask: InputParameter) -> Trajectory | None:
        """The trajectory for `ask`, None if Ruckig finds none."""
        size = ask.degrees_of_freedom
        path = Trajectory(size)
        ruckig = self._ruckigs.setdefault(size, Ruckig(size))
        try:
            done = ruckig.calculate(ask, path) in (Result.Working, Result.Finished)
        except (RuckigError, ValueError):
            return None
        return path if done else None

    def _pace_of(self, limits: FloatArray) -> float:
        """Time for Ruckig per second: it rounds absolute values, and motions may be slow."""
        return float((limits[2] / self.box[2]).max() ** (1 / 3))

    def _limits(self, shares: Shares) -> tuple[FloatArray, FloatArray]:
        """Limits (3, 6) of every axis: `shares` of them and as much jerk as an axis needs, twice.

        The first ends every acceleration before its axis exceeds the velocity limit; with less
        jerk it would continue, to any speed. The second ends it before an axis that slows down
        reverses, too. An axis keeps what it needed until its acceleration ends: with less again it
        would pass its target.
        """
        _, velocity, acceleration = self._state
        speed = np.abs(velocity)
        slows = velocity * acceleration < 0
        least = REST_VELOCITY * self._pace
        room = np.maximum(np.where(slows, speed, self.box[0] - speed), least)
        needed = np.minimum(acceleration**2 / (2 * room) / self.box[2], 1.0)
        kept = np.where(acceleration * self._sign > 0.0, self._jerk, 0.0)
        self._jerk = np.maximum(np.where(slows, 0.0, needed), kept)
        self._sign = np.sign(acceleration)
        limits = self.box * np.array(shares)[:, None]
        limits[2] = np.maximum(limits[2], self.box[2] * self._jerk)
        unreversed = limits.copy()
        unreversed[2] = np.maximum(limits[2], self.box[2] * needed)
        return limits, unreversed

    def _slows(self) -> NDArray[np.bool_]:
        """(6,) which axes slow down, by more than rounding noise."""
        _, velocity, acceleration = self._state
        noise = QUIET[2] * self._pace**2
        return (velocity * acceleration < 0) & (np.abs(acceleration) > noise)

    def resting_pose(self) -> Pose:
        """Brake, and return where the brake will end."""
        if self.at_rest:
            return self.motion.pose
        self.brake()
        if self._plan is None:
            return self.motion.pose
        end = self._plan.end
        return Pose(end[:3], orthonormal(self._anchor @ exp3(end[3:])))

    def brake_from(self, motion: Motion) -> None:
        """Brake from the state of another motion."""
        self.reset(motion.pose)
        body = motion.pose.rotation.T
        (velocity, spin), (change, spin_change) = (
            (values[:3], body @ values[3:]) for values in (motion.twist, motion.acceleration)
        )
        self._state = self._state._replace(
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
        if self._slowing_to is not None and not (self._slows() & self._too_fast).any():
            # They were too fast for their shares, and may go as fast again by the plan there is.
            pose, shares, all_to_stop = self._slowing_to
            self.target(pose, shares, all_to_stop=all_to_stop)
        if self._plan is None:
            return self.motion
        self._elapsed_s += pace * self._dt_s
        position, velocity, acceleration = self._state = self._plan.at(self._elapsed_s)
        if self._elapsed_s >= self._plan.duration_s:
            self._plan = None
        rotation = self._anchor @ exp3(position[3:])
        spin, spin_change = body_rates(position[3:], velocity[3:], acceleration[3:])
        twist, change = velocity.copy(), acceleration.copy()
        twist[3:], change[3:] = rotation @ spin, rotation @ spin_change
        self.motion = Motion(Pose(position[:3].copy(), rotation), twist, change)
        return self.motion

    @property
    def at_rest(self) -> bool:
        """The motion stands, and is not about to start."""
        if self._plan is None:
            return True
        if float(np.abs(self.motion.twist).max()) > REST_VELOCITY:
            return False
        if self.braking:
            return float(np.abs(self.motion.acceleration).max()) < 1e-3
        return float(np.abs(self._target - self._state.position).max()) < REST_OFFSET

    def _anchor_here(self) -> None:
        """Move the anchor to the present rotation, and set noise to zero."""
        position, velocity, acceleration = self._state
        spin, spin_change = body_rates(position[3:], velocity[3:], acceleration[3:])
        self._anchor = orthonormal(self._anchor @ exp3(position[3:]))
        velocity = np.concatenate([velocity[:3], spin])
        acceleration = np.concatenate([acceleration[:3], spin_change])
        velocity[np.abs(velocity) < QUIET[1] * self._pace] = 0.0
        acceleration[np.abs(acceleration) < QUIET[2] * self._pace**2] = 0.0
        self._state = _State(np.concatenate([position[:3], np.zeros(3)]), velocity, acceleration)


def _line(
    way: FloatArray, velocity: FloatArray, acceleration: FloatArray, pace: float
) -> FloatArray | None:
    """The direction of a motion on a straight line through its target, None if it is on none.

    That of the way if there is one; the motion's own where the target is about to be passed, and
    so near that its direction is rounding. Zero where there is neither way nor motion.
    """
    motion = np.stack([way, velocity / pace, acceleration / pace**2])
    lengths = np.sqrt((motion * motion).sum(axis=1))
    if not lengths.any():
        return way
    for value, length in zip(motion, lengths.tolist(), strict=True):
        if length > 0.0:
            line = value / length
            if (np.abs(motion - np.outer(motion @ line, line)) <= _ASIDE).all():
                return line
    return None


def _extrema(path: Trajectory) -> tuple[FloatArray, FloatArray]:
    """(k,) least and greatest positions."""
    low, high = np.array([(one.min, one.max) for one in path.position_extrema]).T
    return low, high
