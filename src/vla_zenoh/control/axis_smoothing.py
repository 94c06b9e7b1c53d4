"""Jerk-limited motion of n axes to a target that may change at any tick, by Ruckig.

A motion on the straight line to its target, or that stands, is planned as one degree of freedom
along that line: it stays on it whatever the limits become. So is that of each group of axes alone;
small motion beside the line gets degrees of freedom of its own. Any other motion has one per axis.
Those along the line, or of all axes, are synchronised in time.

Ruckig finds profiles of a given duration by root finding with a precision of 1e-8. An axis that
stands at its target with rounding noise (a velocity of 1e-16), while another axis takes long, can
get a profile that leaves at full jerk and comes back. So values that Ruckig cannot tell from zero
are set to zero before planning, and a plan in which an axis leaves the range between its start, its
target and its stop is replaced by one in which each axis moves as fast as it can.

Limits are (3, n): velocity, acceleration and jerk of every axis, per second, s^2 and s^3::

    box          all that an axis may do
    limits       the shares asked for, and as much jerk as ends each acceleration before its axis
                 exceeds the velocity limit: jerk >= a^2 / (2 (v_max - |v|))
    unreversed   and as much as ends a deceleration before its axis reverses: jerk >= a^2 / (2 |v|)
    kept         and as much as the motion in progress was planned with, to stop where that would
    hardest      velocity of `limits`, acceleration and jerk of the box

A motion is planned with the first of the last four that takes no detour, each in up to three ways
(`_WAYS`): twelve plans at most, one as a rule. If all of them take one, one of the hardest is
executed: a detour within the limits is better than no plan.

A plan with shares s, s^2, s^3 of the box is the same motion in 1/s of the time. Ruckig, which
rounds absolute values, is given it in a time of its own, at a `time_scale` of s.

Ruckig: Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target
states", RSS 2021.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

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

from vla_zenoh.control.limits import FULL, Shares
from vla_zenoh.types import FloatArray

REST_VELOCITY = 1e-6
"""m/s and rad/s: slower counts as at rest."""
REST_OFFSET = 1e-6
"""m and rad: nearer to the target counts as reached. Ruckig may end some 1e-9 off."""

SOLVER_NOISE = (1e-8, 1e-8, 1e-6)
"""m or rad, per s, per s^2: smaller values are noise and set to zero. The first two are the
precision of Ruckig's solver; such an acceleration changes a velocity by less in a tick. Of a motion
that is slower by a factor, the last two are smaller by it and its square: see
`AxisSmoother._time_scale_of`."""
OVERSHOOT = 1e-6
"""m and rad: rounding by which a plan may leave the range between start, target and stop."""

ASIDE = 2e-7
"""m and rad: a target nearer to the line of the motion is on it; goals are float32, 30 nm off."""
BESIDE = 0.01
"""Part of the limits for motion beside the line."""
_ASIDE = np.array([[ASIDE], *([quiet] for quiet in SOLVER_NOISE[1:])])
"""(3, 1) the same of displacement, velocity and acceleration."""
TINY, MOST = 1e-12, 1e9
"""Ruckig takes no limit of zero and none that is infinite."""
_WAYS = ((Synchronization.Time, False), (Synchronization.No, False), (Synchronization.No, True))
"""Attempts at planning a motion, in order: how axes are synchronised, `slowly` of `_input`."""


class AxisState(NamedTuple):
    """(n,) position, velocity and acceleration of all axes."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class AxisPlan:
    """A planned motion: a path in k coordinates along the columns of a basis.

    Args:
        start: (n,) its start.
        basis: (n, k).
        path: of the k coordinates, which start at zero.
        time_scale: time of the path per second.
    """

    def __init__(
        self, start: FloatArray, basis: FloatArray, path: Trajectory, time_scale: float
    ) -> None:
        self._start, self._basis, self._path, self._time_scale = start, basis, path, time_scale
        self._rates_basis = time_scale * basis
        self._changes_basis = time_scale * time_scale * basis
        self.duration_s: float = path.duration / time_scale
        self.end = start + basis @ path.at_time(path.duration)[0]
        """(n,) its end."""

    @cached_property
    def path_extrema(self) -> tuple[FloatArray, FloatArray]:
        """(k,) least and greatest values of the coordinates on the way."""
        return _extrema(self._path)

    def extrema(self) -> tuple[FloatArray, FloatArray]:
        """(n,) bounds below and above the positions on the way."""
        reached = np.stack([self._basis * extreme for extreme in self.path_extrema])
        least, most = reached.min(axis=0), reached.max(axis=0)
        return self._start + least.sum(axis=1), self._start + most.sum(axis=1)

    def at(self, time_s: float) -> AxisState:
        """State `time_s` after the start."""
        if time_s >= self.duration_s:
            zeros = np.zeros(len(self.end))
            return AxisState(self.end, zeros, zeros)
        position, velocity, acceleration = self._path.at_time(time_s * self._time_scale)
        return AxisState(
            self._start + self._basis.dot(position),
            self._rates_basis.dot(velocity),
            self._changes_basis.dot(acceleration),
        )


class AxisSmoother:
    """Trajectory generator of n axes: moves to targets within motion limits, or brakes.

    Args:
        position: (n,) to stand at.
        dt_s: duration of a tick.
        box: (3, n) limits of velocity, acceleration and jerk of every axis at full shares.
        groups: axes that have a straight line of their own; by default all together.
        within: (m,) least and greatest positions of the first m axes; None: any.
    """

    def __init__(
        self,
        position: FloatArray,
        dt_s: float,
        box: FloatArray,
        groups: tuple[slice, ...] = (slice(None),),
        within: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        self._dt_s, self.box, self._groups, self._within = dt_s, box, groups, within
        self.failures = 0
        self.failure = ""
        """The last motion without a trajectory, in numbers that reproduce it."""
        self.stand(position)

    def stand(self, position: FloatArray) -> None:
        """Stand at `position` (n,) without any motion; only while nothing is streamed."""
        zeros = np.zeros(len(position))
        self.state = AxisState(np.array(position, dtype=np.float64), zeros, zeros)
        """The present state."""
        self._target = self.state.position
        self._plan: AxisPlan | None = None
        self._elapsed_s = 0.0
        self._planned_jerk = zeros
        """(n,) jerk limits that the motion in progress was planned with."""
        self._time_scale = 1.0
        self._again: tuple[Shares, bool] | None = None
        self._too_fast = zeros > 0.0
        self.braking = False

    def move_to(
        self, target: FloatArray, shares: Shares = FULL, *, all_to_stop: bool = False
    ) -> bool:
        """Move to `target` (n,) from the present state, without a step in its derivatives.

        Args:
            target: the axes' target.
            shares: of the limits; a faster motion slows down within them. More jerk is used if the
                arm would otherwise exceed the velocity limit first, or reverse.
            all_to_stop: use all of acceleration and jerk if the shares do not suffice to stop at
                `target`. To stay `within` they are used in any case.

        Returns:
            whether the shares suffice.
        """
        self._settle(shares)
        return self._plan_to(target, shares, all_to_stop)

    def _plan_to(self, target: FloatArray, shares: Shares, all_to_stop: bool) -> bool:
        self.braking, self._target = False, target
        limits, unreversed = self._limits(shares)
        way = target - self.state.position
        way[np.abs(way) < SOLVER_NOISE[0]] = 0.0
        plan, enough = self._towards(way, limits, unreversed, all_to_stop)
        self._begin(plan, shares)
        self._too_fast = self._slows() & (np.abs(self.state.velocity) > limits[0])
        again = self._too_fast.any() and not self.braking
        self._again = (shares, all_to_stop) if again else None
        return enough

    def brake(self) -> None:
        """Come to rest as fast as the limits allow, each axis by itself."""
        self._brake(None)

    def brake_together(self, shares: Shares = FULL) -> None:
        """Come to rest with all axes together, as `shares` of the limits hold for one direction.

        More jerk is used if the arm would otherwise exceed the velocity limit. Axes that do not
        move in proportion may pass their targets: each takes as long as the slowest one.
        """
        self._brake(shares)

    def brake_on_line(self) -> None:
        """Come to rest on the straight line of the motion; on none, each axis by itself."""
        if self.braking:
            return
        self._settle(FULL)  # in the axes of the stop: what is straight in others may not be in them
        self._brake(None if self._line() is None else FULL)

    def _brake(self, shares: Shares | None) -> None:
        if self.braking:
            return
        self._settle(FULL)
        limits = self.box if shares is None else self._limits(shares)[1]
        self._again, self.braking, self._planned_jerk = None, True, limits[2]
        self._begin(self._stop(limits, together=shares is not None), shares or FULL)

    # -- planning -----------------------------------------------------------------------------
    def _begin(self, plan: AxisPlan | None, shares: Shares) -> None:
        """Execute `plan`; without one brake, and if that cannot be planned, stand."""
        self._elapsed_s = 0.0
        if plan is None:
            self.failures += 1
            self.failure = self._described(shares)
            self.braking = True
            plan = self._stop(self.box, together=False)
        if plan is None:
            self.stand(self.state.position)
        else:
            self._plan = plan

    def _described(self, shares: Shares) -> str:
        values = {**self.state._asdict(), "target": self._target, "jerk": self._planned_jerk}
        given = ", ".join(f"{name} {value.tolist()}" for name, value in values.items())
        return f"{given}, shares {[*shares]}, limits {self.box.tolist()}"

    def _towards(
        self, way: FloatArray, limits: FloatArray, unreversed: FloatArray, all_to_stop: bool
    ) -> tuple[AxisPlan | None, bool]:
        """The plan of a motion by `way` (n,) without detours, and whether `limits` suffice.

        To `unreversed` (3, n) it keeps where an axis would else reverse for nothing.
        """
        if not np.isfinite(way).all():
            return None, False
        basis, parts = self._coordinates(way, limits)
        plan: AxisPlan | None = None
        kept = np.array([*unreversed[:2], np.maximum(unreversed[2], self._planned_jerk)])
        hardest = np.concatenate([limits[:1], self.box[1:]])
        attempts = [limits]
        for more in (unreversed, kept, hardest):
            attempts += [more] * bool((attempts[-1] < more).any())
        self._planned_jerk = attempts[-1][2]
        along = basis.T @ way
        for most in attempts:
            may_take = hardest if all_to_stop or most is hardest else kept
            for synchronization, slowly in _WAYS:
                ask = self._input(basis, most, parts, slowly=slowly)
                ask.target_position = along.tolist()
                # Motion beside the line ends as soon as it can, independent of the others.
                ask.per_dof_synchronization = [
                    Synchronization.No if part == BESIDE else synchronization for part in parts
                ]
                path = self._calculated(ask)
                if path is None:
                    continue
                found = AxisPlan(self.state.position, basis, path, self._time_scale_of(most))
                stop = basis, may_take, parts
                if not (self._overshoots(found, along, stop) or self._leaves(found)):
                    self._planned_jerk = most[2]
                    return found, most is limits or most is unreversed
                plan = plan if slowly and plan is not None else found
        return plan, False

    def _leaves(self, plan: AxisPlan) -> bool:
        """Whether a planned motion leaves where it has to stay; from outside it may enter."""
        if self._within is None:
            return False
        low, high = self._within
        bounded = slice(len(low))
        start, end = self.state.position[bounded], plan.end[bounded]
        least, most = (reached[bounded] for reached in plan.extrema())
        low, high = low - OVERSHOOT, high + OVERSHOOT
        below = (np.minimum(start, end) >= low) & (least < low)
        above = (np.maximum(start, end) <= high) & (most > high)
        return bool(below.any() or above.any())

    def _coordinates(self, way: FloatArray, limits: FloatArray) -> tuple[FloatArray, list[float]]:
        """Basis (n, k) with the fewest directions for a motion by `way`, and their limit shares."""
        whole = line_of(way, *self.state[1:], self._time_scale)
        if whole is not None:
            return whole[:, None], [1.0]
        columns: list[FloatArray] = []
        parts: list[float] = []
        for axes in self._groups:
            found, shares = self._directions(way[axes], limits[:, axes], axes)
            columns.append(np.zeros((len(way), len(shares))))
            columns[-1][axes] = found
            parts += shares
        return np.concatenate(columns, axis=1), parts

    def _directions(
        self, way: FloatArray, limits: FloatArray, axes: slice
    ) -> tuple[FloatArray, list[float]]:
        """The same for m axes: (m, k), with `way` (m,) and `limits` (3, m).

        The line, with the directions beside it if the motion there is small; or the axes.
        """
        size = len(way)
        each = np.eye(size), [1.0] * size
        motion = np.array([self.state.velocity[axes], self.state.acceleration[axes]])
        line = line_of(way, motion[0], motion[1], self._time_scale)
        if line is not None:
            return (line[:, None], [1.0]) if line.any() else (np.zeros((size, 0)), [])
        length = float(np.linalg.norm(way))
        if length == 0.0:
            return each
        along = way / length
        beside = motion - np.outer(motion @ along, along)
        others = _across(along)
        with np.errstate(divide="ignore"):
            most = BESIDE * (limits[:, None, :] / np.abs(others)).min(axis=2)
        # Its greatest speed once its acceleration has ended, and its distance until it stops.
        fast, change = np.abs(beside @ others.T)
        fast = fast + change**2 / (2 * most[2])
        goes = fast * np.sqrt(fast / most[2]) + fast**2 / most[1]
        if (goes < OVERSHOOT).all() and (fast < most[0]).all() and (change < most[1]).all():
            beside_it = [BESIDE] * (size - 1)
            return np.stack([along, *others], axis=1), [1.0 - sum(beside_it), *beside_it]
        return each

    def _overshoots(
        self, plan: AxisPlan, target: FloatArray, stop: tuple[FloatArray, FloatArray, list[float]]
    ) -> bool:
        """Whether a coordinate leaves the range between its start, its target (k,) and its stop.

        `stop`: its basis, limits and parts, see `_input`.
        """
        least, most = np.minimum(target, 0.0) - OVERSHOOT, np.maximum(target, 0.0) + OVERSHOOT
        low, high = plan.path_extrema
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

    def _stop(self, limits: FloatArray, *, together: bool) -> AxisPlan | None:
        """The plan of a stop; `together`: on the straight line of the motion, or in one time."""
        line = self._line() if together else None
        basis = np.eye(limits.shape[1]) if line is None else line[:, None]
        ask = self._input(basis, limits, [1.0] * basis.shape[1])
        ask.control_interface = ControlInterface.Velocity
        for synchronization in [Synchronization.Time] * together + [Synchronization.No]:
            ask.synchronization = synchronization
            path = self._calculated(ask)
            if path is not None:
                return AxisPlan(self.state.position, basis, path, self._time_scale_of(limits))
        return None

    def _line(self) -> FloatArray | None:
        """Direction (n,) of a motion in which all axes move in proportion, None of any other."""
        line = line_of(np.zeros(len(self.state.position)), *self.state[1:], 1.0)
        return None if line is None or not line.any() else line

    def _input(
        self, basis: FloatArray, limits: FloatArray, parts: list[float], *, slowly: bool = False
    ) -> InputParameter:
        """Ruckig's input along the columns of `basis` (n, k), each with its part of the limits.

        `slowly`: what is too fast brakes so that it does not fall below half its velocity limit.
        With all of its acceleration it would have to reverse before that has ended.
        """
        _, velocity, acceleration = self.state
        scales = self._time_scale_of(limits) ** np.array([1.0, 2.0, 3.0])
        with np.errstate(divide="ignore"):
            along = (limits[:, :, None] / np.abs(basis)).min(axis=1) * np.array(parts)
            # On a line the axis that needs most jerk decides: the others have to stay with it.
            most = (limits[2] / self.box[2])[:, None] * (basis != 0.0)
            jerk = (self.box[2][:, None] / np.abs(basis)).min(axis=0)
            jerk *= np.maximum(most.max(axis=0), TINY)
        along[2] = jerk * parts
        along /= scales[:, None]
        velocity, acceleration = velocity @ basis / scales[0], acceleration @ basis / scales[1]
        velocity[np.abs(velocity) < SOLVER_NOISE[1]] = 0.0
        acceleration[np.abs(acceleration) < SOLVER_NOISE[2]] = 0.0
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
        path = Trajectory(ask.degrees_of_freedom)
        try:
            done = Ruckig(ask.degrees_of_freedom).calculate(ask, path) in (
                Result.Working,
                Result.Finished,
            )
        except (RuckigError, ValueError):
            return None
        return path if done else None

    def _time_scale_of(self, limits: FloatArray) -> float:
        """Time for Ruckig per second: it rounds absolute values, and motions may be slow."""
        return float((limits[2] / self.box[2]).max() ** (1 / 3))

    def _limits(self, shares: Shares) -> tuple[FloatArray, FloatArray]:
        """Limits (3, n) of every axis: `shares` of them and as much jerk as an axis needs, twice.

        The first ends every acceleration before its axis exceeds the velocity limit; with less
        jerk it would continue, to any speed. The second ends it before an axis that slows down
        reverses, too.
        """
        _, velocity, acceleration = self.state
        speed = np.abs(velocity)
        slows = velocity * acceleration < 0
        least = REST_VELOCITY * self._time_scale
        room = np.maximum(np.where(slows, speed, self.box[0] - speed), least)
        needed = np.minimum(acceleration**2 / (2 * room) / self.box[2], 1.0)
        limits = self.box * np.array(shares)[:, None]
        limits[2] = np.maximum(limits[2], self.box[2] * np.where(slows, 0.0, needed))
        unreversed = limits.copy()
        unreversed[2] = np.maximum(limits[2], self.box[2] * needed)
        return limits, unreversed

    def _slows(self) -> NDArray[np.bool_]:
        """(n,) which axes slow down, by more than rounding noise."""
        _, velocity, acceleration = self.state
        noise = SOLVER_NOISE[2] * self._time_scale**2
        return (velocity * acceleration < 0) & (np.abs(acceleration) > noise)

    # -- moving -------------------------------------------------------------------------------
    def advance(self, part: float) -> bool:
        """Advance the state by `part` of a tick; whether it moves."""
        if self._again is not None and not (self._slows() & self._too_fast).any():
            # They were too fast for their shares, and may go as fast again by the plan there is.
            shares, all_to_stop = self._again
            self._silence(shares)
            self._plan_to(self._target, shares, all_to_stop)
        if self._plan is None:
            return False
        self._elapsed_s += part * self._dt_s
        self.state = self._plan.at(self._elapsed_s)
        if self._elapsed_s >= self._plan.duration_s:
            self._plan = None
        return True

    def braked(self) -> FloatArray:
        """Brake, and return where (n,) the brake will end."""
        if not self.at_rest:
            self.brake()
        return self.state.position if self._plan is None else self._plan.end

    def halfway_to_rest(self) -> FloatArray:
        """Position (n,) after half of the time that is left of the motion in progress."""
        if self._plan is None:
            return self.state.position
        return self._plan.at(0.5 * (self._elapsed_s + self._plan.duration_s)).position

    @property
    def at_rest(self) -> bool:
        """The motion stands, and is not about to start."""
        if self._plan is None:
            return True
        velocity, acceleration = self._rates
        if max(map(abs, velocity.tolist())) > REST_VELOCITY:
            return False
        if self.braking:
            return float(np.abs(acceleration).max()) < 1e-3
        return float(np.abs(self._target - self.state.position).max()) < REST_OFFSET

    @property
    def stands(self) -> bool:
        """Nothing that is commanded moves."""
        return self.at_rest

    @property
    def _rates(self) -> tuple[FloatArray, FloatArray]:
        return self.state[1:]

    def _settle(self, shares: Shares) -> None:
        """Prepare the state for a motion to a new target with these shares."""
        self._silence(shares)

    def _silence(self, shares: Shares) -> None:
        """Set noise to zero, before a motion with these shares is planned."""
        self._time_scale = shares.jerk ** (1 / 3)
        position, velocity, acceleration = self.state
        velocity, acceleration = velocity.copy(), acceleration.copy()
        velocity[np.abs(velocity) < SOLVER_NOISE[1] * self._time_scale] = 0.0
        acceleration[np.abs(acceleration) < SOLVER_NOISE[2] * self._time_scale**2] = 0.0
        self.state = AxisState(position, velocity, acceleration)


def _across(along: FloatArray) -> FloatArray:
    """(n - 1, n) unit vectors across `along` (n,) and across each other."""
    return np.linalg.svd(along[None])[2][1:]


def line_of(
    way: FloatArray, velocity: FloatArray, acceleration: FloatArray, time_scale: float
) -> FloatArray | None:
    """Direction of a motion on a straight line through its target, None if it is on none.

    That of the displacement if there is one; the motion's own if the target is about to be passed
    and so near that the displacement is rounding. Zero without displacement and motion.
    """
    motion = np.stack([way, velocity / time_scale, acceleration / time_scale**2])
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
    """(k,) least and greatest positions.

    Ruckig's own ``position_extrema`` misses what is reached while the acceleration is constant
    (pantor/ruckig, issue 215).
    """
    bounds = [_bounds(profile) for profile in path.profiles[0]]
    low, high = np.array(bounds).T
    return low, high


def _bounds(profile: Any) -> tuple[float, float]:
    """Least and greatest position of one axis: at the ends of its phases, or where it reverses."""
    reached = profile.p[-1:]
    for part in (profile.brake, profile):  # what comes before the seven phases, and these
        for phase in zip(part.t, part.j, part.a, part.v, part.p, strict=False):
            reached += _reached(*phase)
    return min(reached), max(reached)


def _reached(time_s: float, jerk: float, a: float, v: float, start: float) -> list[float]:
    """Where a phase of constant jerk starts, and where its velocity is zero."""
    if time_s <= 0.0:
        return []
    inside = a * a - 2 * jerk * v
    if jerk == 0.0:
        turns_s = [-v / a] if a else []
    elif inside < 0.0:
        turns_s = []
    else:
        root = math.sqrt(inside)
        turns_s = [(-a - root) / jerk, (-a + root) / jerk]
    return [start] + [
        start + turn_s * (v + turn_s * (0.5 * a + turn_s * jerk / 6))
        for turn_s in turns_s
        if 0.0 < turn_s < time_s
    ]
