"""A reference governor: what is told may step, what the controller is given does not.

The reference is what is told plus a difference. Where what is told goes on as a motion within the
profile's limits of jerk could have, the difference stays as it is: a healthy stream has none, and
passes unchanged. Any other step of what is told, however small (a command was late or lost, a
stream begins a little aside, this side itself was woken late), is put into the difference in
position, velocity and acceleration at once, so that the reference goes on as it was. From there the
difference goes to zero, jerk-limited and as gently as `SETTLE_S` allows.

Both are sampled from motions whose jerk is bounded. A difference of third order over ticks of any
length is a mean of that jerk, and so is bounded by the same number; likewise the acceleration and
the velocity.

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

from vla_zenoh.types import FloatArray

BRAKE_MARGIN = 2.0
"""The robot's own stop may use this multiple of the stream's limits."""
ORDINARY = 1.15
"""Part of the stream's limits of jerk within which what is told is taken as it is. The difference
has what is left of `BRAKE_MARGIN`."""
SETTLE_S = 0.02
"""A small difference is gone after about this time, with less jerk than it might have; a large one
takes as long as its limits make it."""
LONG_S = 0.6
"""A difference that would take longer beside a stream that has all of its own jerk is large: what
is told then moves on without jerk, all of that goes into the difference, and that has it all."""
UNIT_S = 0.1
"""Of the numbers that Ruckig is given: it calls everything below 1e-8 zero, whatever it is."""
NOTHING = 1e-7
"""In these units. Ruckig answers noise with all the jerk there is."""
LEAST_JERK = 1e-3
"""Part of the jerk that is planned with at least."""
SLACK, LEAST = 0.1, 0.25
"""Parts of the stream's limits: when what is told has taken so much more of them since, the
difference is planned anew; and so much the difference has at least."""
GRID = 8

Reference = TypeVar("Reference")


class GovernedPath(NamedTuple):
    """A motion beside another one, (n,) each: value, its rate and that one's rate."""

    value: FloatArray
    rate: FloatArray
    change: FloatArray


class Space(Protocol[Reference]):
    """Where references lie, and how one is a way (n,) beside another."""

    def rest(self, motion: Reference) -> Reference:
        """Standing where `motion` is."""
        ...

    def speed(self, motion: Reference) -> GovernedPath:
        """Rate and change of a motion; its value is zero."""
        ...

    def beside(self, base: Reference, way: GovernedPath) -> Reference:
        """The motion that is `way` beside `base`, with its exact rate and change."""
        ...

    def apart(self, motion: Reference, base: Reference) -> GovernedPath:
        """The way `motion` is beside `base`: the inverse of `beside`."""
        ...

    def sizes(self, shares: FloatArray) -> FloatArray:
        """Of numbers (..., n), in parts of their limits, what counts for each axis."""
        ...


class GovernorLimits(NamedTuple):
    """(n,) each: of velocity, acceleration, jerk.

    Args:
        velocity: per axis.
        acceleration: likewise.
        jerk: likewise.
        axis: part of each that one axis may have by itself in a stop, where they bound a norm.
        beside: likewise in a difference, which also turns with what it is beside.
    """

    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    axis: FloatArray
    beside: FloatArray


def _tests() -> FloatArray:
    """(m, 3) rows q with ``|q . (m0, m1, m2)| <= 1`` for the moments of every jerk within +-1.

    ``m_i`` is the integral of ``j(s) (1 - s)^i`` over the unit interval: the change of acceleration
    and velocity, and twice that of position. What a bounded jerk can do is convex, and its bounds
    are touched by jerks that change their sign at most twice: by polynomials of degree 2 with their
    roots there. `GRID` of them a side bound it from outside within two hundredths.
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
    """See the module.

    Args:
        space: where the references lie.
        motion: the reference at first.
        dt_s: of a tick.
        brake: limits of its own stop, `BRAKE_MARGIN` times those of the stream.

    Attributes:
        motion: the reference now.
        told: what it goes to: what was told last, or where it stands.
    """

    def __init__(
        self, space: Space[Reference], motion: Reference, dt_s: float, brake: GovernorLimits
    ) -> None:
        self._space, self._dt_s = space, dt_s
        limits = np.array(brake[:3])
        self._brake = limits * brake.axis
        self._own = limits / BRAKE_MARGIN
        jerk = self._told_jerk = ORDINARY * self._own[2]
        self._reach = np.stack([jerk * dt_s, jerk * dt_s**2, jerk * (dt_s**3 / 2)])
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

    def put(self, motion: Reference) -> None:
        """Stand where `motion` is, whatever was before."""
        self.told = self.motion = self._space.rest(motion)
        self._way: GovernedPath | None = None
        self._cramped: NDArray[np.bool_] | None = None
        self._planned = self._stopping = False

    @property
    def moving(self) -> bool:
        """The reference is not at rest at what it goes to, or that moves."""
        return self._way is not None or bool(self._space.speed(self.told).rate.any())

    def follow(self, told: Reference, *, steady: bool) -> None:
        """Go on as told.

        Args:
            told: where to be now.
            steady: it is known to go on from what was told a tick ago.
        """
        space, goes_on, on = self._space, steady, told
        if self._stopping:
            self._advance()
            goes_on, on = False, self.told
        elif not steady or self._cramped is not None:
            on, share = self._went_on(told)
            goes_on = self._cramped is None and self._could(space.apart(told, on), share)
            self._advance(told, share)
        elif self._way is not None:
            change = space.speed(told).change
            changed = np.array([change, (change - space.speed(self.told).change) / self._dt_s])
            if self._planned and (np.abs(changed) <= self._known).all():
                self._advance()
            else:
                self._advance(told, self._share_of(told))
        if not goes_on:
            at = on if self._way is None else space.beside(on, self._way)
            self._way, self._planned, self._stopping = space.apart(at, told), False, False
        self.told = told
        self.motion = told if self._way is None else space.beside(told, self._way)

    def rest(self) -> None:
        """Go on where nobody tells anything: to where was told last, or to the end of a stop."""
        if not self._stopping:
            moved = self._space.speed(self.told).rate.any()
            self.follow(self._space.rest(self.told), steady=not moved)
            return
        self._advance()
        self.motion = self.told if self._way is None else self._space.beside(self.told, self._way)

    def stop(self) -> None:
        """Come to rest from now on as fast as the limits allow, each axis by itself."""
        self._way, self._cramped = self._space.speed(self.motion), None
        self.told = self._space.rest(self.motion)
        self._stopping = True
        self._plan(self._way, self._brake, ControlInterface.Velocity)
        if not self._planned:  # there is nothing to stop, or nothing was found: stand at once
            self.put(self.motion)

    # -- what is told -------------------------------------------------------------------------
    def _share_of(self, told: Reference) -> FloatArray:
        """The jerk (n,) that leads to `told`, in parts of its limit and not above it."""
        change = self._space.speed(told).change - self._space.speed(self.told).change
        share = change / self._reach[0]
        share = share / np.maximum(self._space.sizes(share), 1.0)
        return share if self._cramped is None else np.where(self._cramped, 0.0, share)

    def _went_on(self, told: Reference) -> tuple[Reference, FloatArray]:
        """What was told a tick ago, gone on with the jerk that brings it nearest to `told`.

        Returns:
            that, and the jerk (n,) in parts of its limit.
        """
        space, dt_s, share = self._space, self._dt_s, self._share_of(told)
        _, rate, change = space.speed(self.told)
        jerk = self._told_jerk * share
        gone = GovernedPath(
            (rate + (change + jerk * (dt_s / 3)) * (dt_s / 2)) * dt_s,
            rate + (change + jerk * (dt_s / 2)) * dt_s,
            change + jerk * dt_s,
        )
        return space.beside(space.rest(self.told), gone), share

    def _could(self, away: GovernedPath, share: FloatArray) -> bool:
        """Whether some jerk within its limit leads so far from where this share of it does."""
        moments = np.array(away[::-1]) / self._reach + np.multiply.outer(_EVEN, share)
        return float(self._space.sizes(_TESTS @ moments).max()) <= 1.0

    # -- the difference -----------------------------------------------------------------------
    def _advance(self, told: Reference | None = None, share: FloatArray | None = None) -> None:
        """Let a tick pass for the difference.

        Args:
            told: what is told at its end; None: nothing is.
            share: (n,) of its jerk that it has meanwhile.
        """
        if self._way is None:
            return
        if told is not None and share is not None:
            _, rate, change = self._space.speed(told)
            taken = self._space.sizes(np.array([rate, change, self._told_jerk * share]) / self._own)
            if not self._planned or (taken > self._taken).any():
                self._settle(self._way, taken)
        if self._way is None:
            return
        if not self._planned:  # none was found: it goes on for a tick, and another is looked for
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
                self.put(self._space.beside(self.told, self._way))
            self._way, self._planned, self._cramped = None, False, None

    def _settle(self, way: GovernedPath, taken: FloatArray) -> None:
        """Plan the difference to zero, within what is left beside what is told (3, n)."""
        needed = _jerk(way, SETTLE_S)
        self._taken = taken + self._slack
        self._known = self._taken[1:] * self._own[1:]
        left = np.maximum(BRAKE_MARGIN - self._taken, LEAST)
        velocity, acceleration, jerk = left * self._own * self._axis
        cramped = _jerk(way, LONG_S) > (BRAKE_MARGIN - ORDINARY) * self._own[2] * self._axis
        self._cramped = cramped if cramped.any() else None
        jerk = np.minimum(np.maximum(needed, LEAST_JERK * jerk), jerk)
        self._plan(way, (velocity, acceleration, jerk), ControlInterface.Position)

    def _plan(
        self, way: GovernedPath, limits: Iterable[FloatArray], interface: ControlInterface
    ) -> None:
        """Plan the way to rest, in numbers near 1: each axis has units of its own."""
        velocity, acceleration, jerk = limits
        length = self._length = jerk * UNIT_S**3
        units = np.array([length, length / UNIT_S, length / UNIT_S**2])
        start = np.array(way) / units
        start[:, (np.abs(start) < NOTHING).all(axis=0)] = 0.0
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
    """About the jerk (n,) with which a way comes to rest at zero within this time."""
    value, rate, change = np.abs(way)
    return (32 * value / time_s + 16 * rate) / time_s**2 + 6 * change / time_s
