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

from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory
from ruckig import RuckigError as PlanError

from vla_zenoh.types import FloatArray

BRAKE_MARGIN = 2.0
"""The robot's own stop, and what makes up for a step, may use this multiple of the stream's
limits."""
ORDINARY = 1.15
"""Part of the stream's limits of jerk within which what is told is taken as it is. The difference
has what is left of `BRAKE_MARGIN`."""
SETTLE_S = 0.2
"""A small difference is gone after about this time, with less jerk than it might have; a large one
takes as long as its limits make it."""
UNIT_S = 0.1
"""Of the numbers that Ruckig is given: it calls everything below 1e-8 zero, whatever it is."""
NOTHING = 1e-7
"""In these units. Ruckig answers noise with all the jerk there is."""
LEAST_JERK = 1e-3
"""Part of the jerk that is planned with at least."""
GRID = 12

Told = TypeVar("Told")


class Way(NamedTuple):
    """A motion beside another one, (n,) each: value, its rate and that one's rate."""

    value: FloatArray
    rate: FloatArray
    change: FloatArray


class Space(Protocol[Told]):
    """Where references lie, and how one is a way (n,) beside another."""

    def rest(self, motion: Told) -> Told:
        """Standing where `motion` is."""
        ...

    def speed(self, motion: Told) -> Way:
        """Rate and change of a motion; its value is zero."""
        ...

    def beside(self, base: Told, way: Way) -> Told:
        """The motion that is `way` beside `base`, with its exact rate and change."""
        ...

    def apart(self, motion: Told, base: Told) -> Way:
        """The way `motion` is beside `base`: the inverse of `beside`."""
        ...

    def greatest(self, shares: FloatArray) -> float:
        """Of numbers (..., n), in parts of their limits, the greatest that counts."""
        ...

    def bounded(self, shares: FloatArray) -> FloatArray:
        """(n,) in parts of their limits, cut to 1."""
        ...


class Limits(NamedTuple):
    """(n,) each: of velocity, acceleration, jerk.

    Args:
        velocity: per axis.
        acceleration: likewise.
        jerk: likewise.
        axis: part of each that one axis may have by itself, where they bound a norm.
    """

    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    axis: FloatArray


def _tests() -> FloatArray:
    """(m, 3) rows q with ``|q . (m0, m1, m2)| <= 1`` for the moments of every jerk within +-1.

    ``m_i`` is the integral of ``j(s) (1 - s)^i`` over the unit interval: the change of acceleration
    and velocity, and twice that of position. What a bounded jerk can do is convex, and its bounds
    are touched by jerks that change their sign at most twice: by polynomials of degree 2 with their
    roots there. `GRID` of them a side bound it from outside within a hundredth.
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


class _Path:
    """A motion of n axes to rest, each by itself.

    Args:
        trajectory: in units of `length` and `UNIT_S`.
        length: (n,).
    """

    def __init__(self, trajectory: Trajectory, length: FloatArray) -> None:
        self._trajectory, self._length = trajectory, length
        self._rate, self._change = length / UNIT_S, length / UNIT_S**2
        self._time_s = 0.0
        self.duration_s = trajectory.duration * UNIT_S

    def tick(self, dt_s: float) -> Way:
        self._time_s += dt_s
        value, rate, change = self._trajectory.at_time(self._time_s / UNIT_S)
        return Way(value * self._length, rate * self._rate, change * self._change)

    @property
    def over(self) -> bool:
        return self._time_s >= self.duration_s


class Governor(Generic[Told]):
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

    def __init__(self, space: Space[Told], motion: Told, dt_s: float, brake: Limits) -> None:
        self._space, self._dt_s = space, dt_s
        self._brake = np.array(brake[:3]) * brake.axis
        self._beside = self._brake * ((BRAKE_MARGIN - ORDINARY) / BRAKE_MARGIN)
        self._told_jerk = brake.jerk * (ORDINARY / BRAKE_MARGIN)
        jerk = self._told_jerk
        self._reach = np.stack([jerk * dt_s, jerk * dt_s**2, jerk * (dt_s**3 / 2)])
        size = len(brake.jerk)
        self._ruckig, self._size = Ruckig(size), size
        self.put(motion)

    def put(self, motion: Told) -> None:
        """Stand where `motion` is, whatever was before."""
        self.told = self.motion = self._space.rest(motion)
        self._path: _Path | None = None
        self._stopping = False

    @property
    def moving(self) -> bool:
        """The reference is not at rest at what it goes to, or that moves."""
        return self._path is not None or bool(self._space.speed(self.told).rate.any())

    @property
    def stopping(self) -> bool:
        """It comes to rest wherever that is, and goes to nothing that was told."""
        return self._stopping

    def tick(self) -> None:
        """Go on where nothing new is told: to rest, or to what was told last, which stands."""
        way = self._advance()
        self.motion = self.told if way is None else self._space.beside(self.told, way)

    def follow(self, told: Told, *, steady: bool) -> None:
        """Go on as told.

        Args:
            told: where to be now.
            steady: it is known to go on from what was told a tick ago.
        """
        way, space = self._advance(), self._space
        if self._stopping or not steady:
            on, share = self._went_on(told)
            if self._stopping or not self._could(space.apart(told, on), share):
                on = self.told if self._stopping else on
                way = space.apart(on if way is None else space.beside(on, way), told)
                self._stopping = False
                if not self._settle(way):
                    self.motion = space.beside(told, way)
                    self.stop()
                    return
                way = way if self._path else None
        self.told = told
        self.motion = told if way is None else space.beside(told, way)

    def rest(self) -> None:
        """Nobody tells anything any more: go to where was told last."""
        if not self._stopping:
            self.follow(self._space.rest(self.told), steady=False)

    def stop(self) -> None:
        """Come to rest as fast as the limits allow, each axis by itself."""
        speed = self._space.speed(self.motion)
        self.told = self._space.rest(self.motion)
        self._stopping = True
        if not self._plan(speed, self._brake, ControlInterface.Velocity) or self._path is None:
            self.put(self.motion)

    def _advance(self) -> Way | None:
        if self._path is None:
            return None
        way = self._path.tick(self._dt_s)
        if not self._path.over:
            return way
        self._path = None
        if self._stopping:
            self.put(self._space.beside(self.told, way))
        return None

    def _went_on(self, told: Told) -> tuple[Told, FloatArray]:
        """What was told a tick ago, gone on with the jerk that brings it nearest to `told`.

        Returns:
            that, and the jerk (n,) in parts of its limit.
        """
        space, dt_s, jerk = self._space, self._dt_s, self._told_jerk
        _, rate, change = space.speed(self.told)
        share = space.bounded((space.speed(told).change - change) / (dt_s * jerk))
        jerk = jerk * share
        gone = Way(
            (rate + (change + jerk * (dt_s / 3)) * (dt_s / 2)) * dt_s,
            rate + (change + jerk * (dt_s / 2)) * dt_s,
            change + jerk * dt_s,
        )
        return space.beside(space.rest(self.told), gone), share

    def _could(self, away: Way, share: FloatArray) -> bool:
        """Whether some jerk within its limit leads so far from where this share of it does."""
        moments = np.array(away[::-1]) / self._reach + np.multiply.outer(_EVEN, share)
        return self._space.greatest(_TESTS @ moments) <= 1.0

    def _settle(self, way: Way) -> bool:
        """Plan the difference to zero."""
        value, rate, change = np.abs(way)
        t = SETTLE_S
        needed = (32 * value / t + 16 * rate) / t**2 + 6 * change / t
        velocity, acceleration, jerk = self._beside
        jerk = np.clip(needed, LEAST_JERK * jerk, jerk)
        return self._plan(way, np.stack([velocity, acceleration, jerk]), ControlInterface.Position)

    def _plan(self, way: Way, limits: FloatArray, interface: ControlInterface) -> bool:
        """Whether a path to rest could be planned; where there is nothing to do, there is none."""
        velocity, acceleration, jerk = limits
        length = jerk * UNIT_S**3
        units = np.stack([length, length / UNIT_S, length / UNIT_S**2])
        start = np.array(way) / units
        nothing = (np.abs(start) < NOTHING).all(axis=0)
        if nothing.all():
            self._path = None
            return True
        start[:, nothing] = 0.0
        ask, trajectory = InputParameter(self._size), Trajectory(self._size)
        ask.control_interface = interface
        ask.synchronization = Synchronization.No
        ask.current_position, ask.current_velocity, ask.current_acceleration = start.tolist()
        ask.max_velocity = (velocity / units[1]).tolist()
        ask.max_acceleration = (acceleration / units[2]).tolist()
        ask.max_jerk = [1.0] * self._size
        try:
            self._ruckig.calculate(ask, trajectory)
        except (PlanError, ValueError):
            return False
        self._path = _Path(trajectory, length)
        return True
