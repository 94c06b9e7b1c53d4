"""Reference governor: commanded set-points may step, the reference for the controller does not.

The reference is the commanded path plus a difference. As long as the commanded path goes on as a
motion within the profile's jerk limits could, the difference stays as it is: a healthy stream has
none and passes unchanged. Any other step, however small (a command was late or lost, a stream
begins a little aside, this loop was late), goes into the position, velocity and acceleration of the
difference at once, so that the reference continues. The difference then goes to zero,
jerk-limited and as gently as `SETTLE_S` allows.

Both are sampled from motions of bounded jerk. A third-order difference over ticks of any length is
a mean of that jerk and has the same bound; so have acceleration and velocity.

Ruckig: Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target
states", RSS 2021.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from ruckig import (
    ControlInterface,
    InputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from vla_zenoh.control.smoothing import Motion
from vla_zenoh.kinematics.so3 import Pose, cross3, exp3, log3, rates_of, spatial_rates
from vla_zenoh.types import FloatArray, JointReference

BRAKE_MARGIN = 2.0
"""The robot's own stop may use this multiple of the stream's limits."""
ORDINARY = 1.15
"""Multiple of the stream's jerk limits within which the commanded path passes unchanged. The
difference has the rest of `BRAKE_MARGIN`."""
SETTLE_S = 0.02
"""A small difference is gone after about this time, with less jerk than allowed; a large one takes
as long as its limits require."""
LONG_S = 0.6
"""A difference is large if it would take longer beside a stream that uses all of its own jerk. The
commanded path then goes on without jerk, and the difference gets all of it."""
UNIT_S = 0.1
"""Unit of the numbers given to Ruckig, which takes everything below 1e-8 for zero."""
NOISE_UNITS = 1e-7
"""In these units. Ruckig would answer noise with full jerk."""
LEAST_JERK = 1e-3
"""Least share of the jerk for planning."""
SLACK, LEAST_LEFT = 0.1, 0.25
"""Shares of the stream's limits. The difference is replanned when the commanded path takes `SLACK`
more of them; it always has `LEAST_LEFT`."""
REVERSAL = 0.15
"""Share of the jerk that the difference leaves unused. Where the commanded path's jerk reverses
within a tick, a third-order finite difference weighs its parts unevenly: by up to 1/8 of the jerk
more than the mean that is known here."""
GIVES_WAY = (BRAKE_MARGIN - ORDINARY - SLACK - REVERSAL) / ORDINARY
"""How fast the acceleration of the difference goes back where that of the commanded path begins to
rise, as a share of how fast this does."""
GRID = 8
"""Roots a side of the polynomials that `_tests` takes: more tests, and a tighter bound."""
AT_REST = np.zeros(6)
"""Twist and acceleration of a pose that stands."""

Reference = TypeVar("Reference")


class GovernedPath(NamedTuple):
    """Offset of one motion from another: value, first and second derivative, (n,) each."""

    value: FloatArray
    rate: FloatArray
    change: FloatArray


class Space(Protocol[Reference]):
    """Space of references; a `way` (n,) is the offset of one from another.

    ``rest`` is at rest at the place of a motion; ``speed`` its rate and change, with value zero;
    ``beside`` the motion at the offset `way` from `base`, with its exact rate and change; ``apart``
    the inverse of that; ``sizes``, from shares (..., n) of the limits, those that count per axis.
    """

    def rest(self, motion: Reference) -> Reference: ...
    def speed(self, motion: Reference) -> GovernedPath: ...
    def beside(self, base: Reference, way: GovernedPath) -> Reference: ...
    def apart(self, motion: Reference, base: Reference) -> GovernedPath: ...
    def sizes(self, shares: FloatArray) -> FloatArray: ...


class PoseSpace:
    """Space of TCP poses. An offset is a translation and the vector r of ``exp3(r) R``."""

    def rest(self, motion: Motion) -> Motion:
        return Motion(motion.pose, AT_REST, AT_REST)

    def speed(self, motion: Motion) -> GovernedPath:
        return GovernedPath(AT_REST, motion.twist, motion.acceleration)

    def beside(self, base: Motion, way: GovernedPath) -> Motion:
        turn = exp3(way.value[3:])
        spin, spin_change = spatial_rates(way.value[3:], way.rate[3:], way.change[3:])
        twist, acceleration = base.twist + way.rate, base.acceleration + way.change
        if base.twist is not AT_REST:
            carried = turn @ base.twist[3:]
            spin_change += turn @ base.acceleration[3:] + cross3(spin, carried)
            spin += carried
        twist[3:], acceleration[3:] = spin, spin_change
        pose = Pose(base.pose.position_m + way.value[:3], turn @ base.pose.rotation)
        return Motion(pose, twist, acceleration)

    def apart(self, motion: Motion, base: Motion) -> GovernedPath:
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


class JointSpace:
    """Space of joint positions (n,); an offset is their difference."""

    def rest(self, motion: JointReference) -> JointReference:
        return JointReference.at_rest(motion.position_rad)

    def speed(self, motion: JointReference) -> GovernedPath:
        _, velocity_rad_s, acceleration_rad_s2 = motion
        return GovernedPath(np.zeros(len(velocity_rad_s)), velocity_rad_s, acceleration_rad_s2)

    def beside(self, base: JointReference, way: GovernedPath) -> JointReference:
        return JointReference(base[0] + way[0], base[1] + way[1], base[2] + way[2])

    def apart(self, motion: JointReference, base: JointReference) -> GovernedPath:
        return GovernedPath(motion[0] - base[0], motion[1] - base[1], motion[2] - base[2])

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Every joint counts by itself."""
        return np.abs(shares)


class GovernorLimits(NamedTuple):
    """Limits of the reference per axis, (n,) each.

    Args:
        velocity, acceleration, jerk: of the axis.
        axis: share that one axis may use in a stop, where the limits bound a norm.
        beside: share in a difference, which also rotates with the commanded path.
    """

    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    axis: FloatArray
    beside: FloatArray


def _tests() -> FloatArray:
    """(m, 3) rows q with ``|q . (m0, m1, m2)| <= 1`` for the moments of every jerk within +-1.

    ``m_i`` is the integral of ``j(s) (1 - s)^i`` over the unit interval: the change of acceleration
    and velocity, and twice that of position. The set a bounded jerk can reach is convex; its bounds
    are touched by jerks that change sign at most twice, i.e. by polynomials of degree 2 with these
    roots. `GRID` roots a side bound the set from outside within 2 %.
    """
    u = (np.arange(2000) + 0.5) / 2000
    places = np.arange(GRID + 1) / GRID
    rows = [np.array([x * y, -(x + y), 1.0]) for x in places for y in places if x <= y]
    rows += [np.array([-x, 1.0, 0.0]) for x in places]
    powers = np.stack([np.ones_like(u), u, u * u])
    return np.array([row / np.abs(row @ powers).mean() for row in rows])


_TESTS = _tests()
_EVEN = np.array([1.0, 1 / 2, 1 / 3])
"""Moments of a jerk of 1."""


class ReferenceGovernor(Generic[Reference]):
    """Turns a commanded path that may step into a jerk-limited reference.

    Args:
        space: of the references.
        motion: the reference at first.
        dt_s: period of a tick.
        brake: limits of its own stop, `BRAKE_MARGIN` times those of the stream.

    Attributes:
        motion: the reference now.
        target: where it goes: the last commanded set-point, or where it stands.
    """

    def __init__(
        self, space: Space[Reference], motion: Reference, dt_s: float, brake: GovernorLimits
    ) -> None:
        self._space, self._dt_s = space, dt_s
        limits = np.array(brake[:3])
        self._brake = limits * brake.axis
        self._own = limits / BRAKE_MARGIN
        self._target_jerk = ORDINARY * self._own[2]
        self._reach = self._reach_in(dt_s)
        self._axis = brake.beside
        velocity, acceleration, jerk = self._own
        changes = [acceleration * dt_s / velocity, jerk * dt_s / acceleration, 0.0 * jerk]
        self._slack = np.maximum(SLACK, ORDINARY * np.stack(changes))
        size = len(jerk)
        self._ruckig, self._ask = Ruckig(size), InputParameter(size)
        self._ask.synchronization = Synchronization.No
        self._ask.max_jerk = [1.0] * size
        self._trajectory = Trajectory(size)
        self._time_s, self._length = 0.0, jerk
        self._taken = self._known = limits
        self.put(motion)

    def set_period(self, dt_s: float) -> None:
        """Let the next tick last `dt_s`."""
        if dt_s != self._dt_s:
            self._dt_s, self._reach = dt_s, self._reach_in(dt_s)

    def _reach_in(self, dt_s: float) -> FloatArray:
        """(3, n) what the jerk of the commanded path changes within a tick."""
        jerk = self._target_jerk
        return np.stack([jerk * dt_s, jerk * dt_s**2, jerk * (dt_s**3 / 2)])

    def put(self, motion: Reference) -> None:
        """Hold the place of `motion` at once."""
        self.target = self.motion = self._space.rest(motion)
        self._way: GovernedPath | None = None
        self._cramped: NDArray[np.bool_] | None = None
        self._planned = self._stopping = False
        self._stands = True  # nothing changes until the next command

    @property
    def moving(self) -> bool:
        """The reference is not yet where it goes, or that moves."""
        return self._way is not None or bool(self._space.speed(self.target).rate.any())

    def follow(self, target: Reference, *, steady: bool) -> None:
        """Advance by a tick along the commanded path.

        Args:
            target: commanded set-point of this tick.
            steady: it is known to continue the one of the last tick.
        """
        space, goes_on, on = self._space, steady, target
        self._stands = False
        if self._stopping:
            self._advance()
            goes_on, on = False, self.target
        elif not steady or self._cramped is not None:
            on, share = self._went_on(target)
            goes_on = self._cramped is None and self._could(space.apart(target, on), share)
            self._advance(target if goes_on else on, share)
        elif self._way is not None:
            change = space.speed(target).change
            changed = np.array([change, (change - space.speed(self.target).change) / self._dt_s])
            if self._planned and (np.abs(changed) <= self._known).all():
                self._advance()
            else:
                self._advance(target, self._share_of(target))
        if not goes_on:
            at = on if self._way is None else space.beside(on, self._way)
            self._way, self._planned, self._stopping = space.apart(at, target), False, False
        self.target = target
        self.motion = self._beside_target()

    def rest(self) -> None:
        """Advance by a tick without a command: to the last set-point, or to the end of a stop."""
        if self._stands:
            return
        if not self._stopping:
            moved = self._space.speed(self.target).rate.any()
            self.follow(self._space.rest(self.target), steady=not moved)
            self._stands = self._way is None and not moved
            return
        self._advance()
        self.motion = self._beside_target()

    def stop(self) -> None:
        """Brake to rest as fast as the limits allow, each axis by itself."""
        self._way, self._cramped = self._space.speed(self.motion), None
        self.target = self._space.rest(self.motion)
        self._stopping, self._stands = True, False
        self._plan(self._way, self._brake, ControlInterface.Velocity)
        if not self._planned:  # nothing to stop, or no plan: stand at once
            self.put(self.motion)

    def _beside_target(self) -> Reference:
        return self.target if self._way is None else self._space.beside(self.target, self._way)

    # -- commanded path -----------------------------------------------------------------------
    def _share_of(self, target: Reference) -> FloatArray:
        """The jerk (n,) that leads to `target`, as shares of its limit, at most 1."""
        change = self._space.speed(target).change - self._space.speed(self.target).change
        share = change / self._reach[0]
        share = share / np.maximum(self._space.sizes(share), 1.0)
        return share if self._cramped is None else np.where(self._cramped, 0.0, share)

    def _went_on(self, target: Reference) -> tuple[Reference, FloatArray]:
        """The last set-point, continued with the jerk that leads nearest to `target`.

        The second result is that jerk (n,), as shares of its limit.
        """
        space, dt_s, share = self._space, self._dt_s, self._share_of(target)
        _, rate, change = space.speed(self.target)
        jerk = self._target_jerk * share
        gone = GovernedPath(
            (rate + (change + jerk * (dt_s / 3)) * (dt_s / 2)) * dt_s,
            rate + (change + jerk * (dt_s / 2)) * dt_s,
            change + jerk * dt_s,
        )
        return space.beside(space.rest(self.target), gone), share

    def _could(self, away: GovernedPath, share: FloatArray) -> bool:
        """Whether a jerk within its limit leads this far away from where this share of it leads."""
        moments = np.array(away[::-1]) / self._reach + np.multiply.outer(_EVEN, share)
        return float(self._space.sizes(_TESTS @ moments).max()) <= 1.0

    # -- the difference -----------------------------------------------------------------------
    def _advance(self, target: Reference | None = None, share: FloatArray | None = None) -> None:
        """Advance the difference by a tick.

        At its end the set-point `target` is commanded, if any, with this `share` (n,) of the jerk.
        """
        if self._way is None:
            return
        if target is not None and share is not None:
            _, rate, change = self._space.speed(target)
            taken = self._space.sizes(
                np.array([rate, change, self._target_jerk * share]) / self._own
            )
            if not self._planned or (taken > self._taken).any():
                self._settle(self._way, taken)
        if self._way is None:
            return
        if not self._planned:  # no plan: coast for a tick and try again
            value, rate, change = self._way
            self._way = GovernedPath(value + self._dt_s * rate, rate, np.zeros(len(rate)))
            return
        self._time_s += self._dt_s
        value, rate, change = self._trajectory.at_time(self._time_s / UNIT_S)
        length = self._length
        self._way = GovernedPath(
            value * length, rate * length / UNIT_S, change * length / UNIT_S**2
        )
        if self._time_s >= self._trajectory.duration * UNIT_S:
            if self._stopping:
                self.put(self._space.beside(self.target, self._way))
            self._way = self._cramped = None

    def _settle(self, way: GovernedPath, taken: FloatArray) -> None:
        """Plan the difference to zero, beside a path that takes these shares (3, n)."""
        needed = _jerk(way, SETTLE_S)
        self._taken = taken + self._slack
        self._known = self._taken[1:] * self._own[1:]
        left = BRAKE_MARGIN - self._taken
        left[2] -= REVERSAL
        # The commanded path may begin to accelerate: the difference has less jerk, and gives way.
        left[1] -= (1.0 - GIVES_WAY) * np.maximum(1.0 - taken[1], 0.0)
        left = np.maximum(left, LEAST_LEFT)
        velocity, acceleration, jerk = left * self._own * self._axis
        cramped = _jerk(way, LONG_S) > (BRAKE_MARGIN - ORDINARY) * self._own[2] * self._axis
        self._cramped = cramped if cramped.any() else None
        jerk = np.minimum(np.maximum(needed, LEAST_JERK * jerk), jerk)
        self._plan(way, (velocity, acceleration, jerk), ControlInterface.Position)

    def _plan(
        self, way: GovernedPath, limits: Iterable[FloatArray], interface: ControlInterface
    ) -> None:
        """Plan the way to rest; each axis has units of its own, so that numbers are near 1."""
        velocity, acceleration, jerk = limits
        length = self._length = jerk * UNIT_S**3
        units = np.array([length, length / UNIT_S, length / UNIT_S**2])
        start = np.array(way) / units
        start[:, (np.abs(start) < NOISE_UNITS).all(axis=0)] = 0.0
        self._planned, self._time_s = False, 0.0
        if not start.any():
            self._way = self._cramped = None
            return
        ask = self._ask
        ask.control_interface = interface
        ask.current_position, ask.current_velocity, ask.current_acceleration = start.tolist()
        ask.max_velocity = (velocity / units[1]).tolist()
        ask.max_acceleration = (acceleration / units[2]).tolist()
        with contextlib.suppress(RuckigError, ValueError):
            self._ruckig.calculate(ask, self._trajectory)
            self._planned = True


def _jerk(way: GovernedPath, time_s: float) -> FloatArray:
    """Approximate jerk (n,) with which a way comes to rest at zero within this time."""
    value, rate, change = np.abs(way)
    return (32 * value / time_s + 16 * rate) / time_s**2 + 6 * change / time_s
