"""How fast to go to a goal, so that an arm neither stops nor rushes between the steps of a policy.

A step has a duration. An arm that goes to each goal as fast as it can waits there for the next one:
stop and go, at every step of a policy that answers one step at a time. Here the arm is given the
time that the step has. With plan time t, a plan that arrived at ``a`` with ``u`` of its H steps
gone, and the next chunk expected at ``x``::

    D_k = a + (k - u) dt f     f = max(1, (x - a) / ((H - u) dt))    step k is due
    A_k = D_k + m              m = spare + stop(v) / 2               and arrived at
    v   = |W_k - p| / (A_k - t)

Steps last dt, or longer where the chunk would be over before the next one is expected. ``stop(v)``
is how long a stop from v takes: braking for W_k, where the arm would stand, begins at D_k + spare
and not before, and by then the next goal is there. So the speed is constant while goals come in
time and evenly, and the arm is ``v m`` behind them. Where no goal follows it comes to rest at the
last one, before the watchdog would brake it. ``x`` is a phase-locked clock of the arrivals (an
alpha-beta filter), ``spare`` three times their mean deviation from it: an inference varies.

Only the speed is bounded by this. Which goal is in force when, and where the arm ends, are those of
`vla_zenoh.control.plan_timeline`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.commander_io import make_event
from vla_zenoh.control.joint_space import JointPath
from vla_zenoh.control.limits import APPROACH, FULL, Shares, Slowdown, slowest, stop_s_of
from vla_zenoh.control.plan_timeline import Goal, Plan
from vla_zenoh.control.pose_to_joint import LEAST_SPEED
from vla_zenoh.control.smoothing import PosePath
from vla_zenoh.types import Event, FloatArray

PHASE, PERIOD, DEVIATION = 0.3, 0.1, 0.2
"""Gains of the clock of arrivals: its phase, its period, and the mean deviation from it."""
FIRST_DEVIATION = 0.1
"""Part of the asked period that arrivals are taken to deviate by before that is known."""
SPARE = 3.0
"""Mean deviations for which the arm still has a distance to go when a chunk is late."""
CHANGE = 0.4
"""Part of the change to the wanted speed that a moving arm makes at each goal."""
MOVING = 0.85
"""Part of the wanted speed above which it does so; a slower arm takes all of it."""
SOON_NS = 1_000_000
"""A goal that is overdue has this much time: the share is that of full speed then."""
MARGIN_NS = 10_000_000
"""Spare time at least: two ticks at 250 Hz, and what a message takes on one host."""
EASING = 0.1
"""Part of the time by which what is kept in reserve may change; half of it how late the arm is."""


Mover = PosePath | JointPath
"""What moves the arm."""
MIXED = 1.1
"""Rates of a rotation at their limits are this much larger along the axes of the next plan."""


class Arrivals:
    """When the next chunk is expected, in plan time."""

    def __init__(self) -> None:
        self._last_ns: float | None = None
        self._period_ns = self._deviation_ns = 0.0
        self._intervals = 0

    def arrived(self, now_ns: int, asked_period_ns: float) -> tuple[float, float]:
        """When the next chunk is expected after one that arrived, and how much later it may be.

        The worker is asked for one in every `asked_period_ns`.
        """
        if self._last_ns is None:
            self._last_ns, self._period_ns = now_ns, asked_period_ns
            self._deviation_ns = FIRST_DEVIATION * asked_period_ns
        else:
            self._intervals += 1
            next_ns = self._last_ns + self._period_ns
            late_ns, half_ns = now_ns - next_ns, 0.5 * self._period_ns
            # The first intervals weigh most: a slow model is asked less often than requested.
            phase, period = max(PHASE, 1 / self._intervals), max(PERIOD, 1 / self._intervals)
            self._last_ns = min(max(next_ns + phase * late_ns, now_ns - half_ns), now_ns + half_ns)
            self._period_ns = max(self._period_ns + period * late_ns, 0.5 * asked_period_ns)
            self._deviation_ns += DEVIATION * (abs(late_ns) - self._deviation_ns)
        return self._last_ns + self._period_ns, SPARE * self._deviation_ns


class StepTiming:
    """The speed to each goal, for plans since the arm stood; see the module.

    Args:
        box: (3, 6) velocity, acceleration and jerk limits of every axis.
    """

    def __init__(self, box: FloatArray) -> None:
        self._box = box
        self._arrivals = Arrivals()
        self._plan: Plan | None = None
        self._took_ns = 0
        self._begun_ns = self._late_ns = 0.0
        self._gone = self._stretch = self._spare_ns = 0.0

    def share(
        self,
        plan: Plan,
        index: int,
        now_ns: int,
        asked_period_s: float,
        left_s: float,
        way: FloatArray,
        velocity: FloatArray,
    ) -> float:
        """Share of the velocity limits for the way to a goal.

        Args:
            plan: the newest.
            index: of its goal in force.
            now_ns: wall time.
            asked_period_s: between two chunks, in plan time.
            left_s: until the watchdog brakes, if no chunk comes.
            way: (6,) from the commanded pose to the goal, m and rad.
            velocity: (6,) at present, m/s and rad/s, in the same axes.
        """
        if plan.cause is None:
            return 1.0
        plan_ns = plan.clock.at(now_ns)
        if plan is not self._plan:
            self._take(plan, plan_ns, asked_period_s)
        due_ns = self._begun_ns + (index + 1 - self._gone) * plan.dt_ns * self._stretch
        override = plan.clock.override
        time_s = max(due_ns - plan_ns + self._spare_ns, SOON_NS) / 1e9 / override
        limits = self._box[0]
        ways_s = np.abs(way) / limits
        leading = int(ways_s.argmax())
        length = float(ways_s[leading])  # s at full speed
        if length <= 0.0:
            return 1.0
        now = float((np.abs(velocity) / limits).max())
        # In units of the velocity limits along the way, as the limits of the other orders are.
        most, jerk = self._box[1:, leading] / limits[leading]
        most, jerk = most * override**2, jerk * override**3
        share = least = length / time_s
        for _ in range(3):
            stop_s = stop_s_of(min(share, 1.0), most, jerk)
            share = length / (time_s + 0.5 * stop_s)
            least = length / max(left_s - 0.6 * stop_s, 1e-3)
        if MOVING * share < now:
            share = now + CHANGE * (share - now)
        share = max(share, least)
        return min(max(share, LEAST_SPEED), 1.0)

    def _take(self, plan: Plan, plan_ns: int, asked_period_s: float) -> None:
        next_ns, late_by_ns = self._arrivals.arrived(plan_ns, asked_period_s * 1e9)
        steps, before = len(plan.goals), self._plan
        self._gone = 0.0
        if before is not None:
            now_ns = plan.clock.wall_at(plan_ns)
            asked = before.steps_until(now_ns) - before.steps_until(plan.start_ns)
            self._gone = min(max(asked * before.dt_ns / plan.dt_ns, 0.0), steps - 1.0)
        lasts_ns = (steps - self._gone) * plan.dt_ns
        wait_ns = max(next_ns - plan_ns, 0.0)
        self._stretch = max(1.0, wait_ns / lasts_ns)
        covered_ns = lasts_ns * self._stretch - wait_ns
        spare_ns = MARGIN_NS + max(0.0, late_by_ns - covered_ns)
        most_ns = EASING * (plan_ns - self._took_ns) if before is not None else math.inf
        self._spare_ns += min(max(spare_ns - self._spare_ns, -most_ns), most_ns)
        # An arm that began late, by what the first inference took, does not make up for it at once.
        late_ns = plan_ns - plan.clock.at(plan.start_ns) - self._gone * plan.dt_ns
        kept_ns = late_ns
        if before is not None and self._stretch == 1.0:
            kept_ns = self._late_ns - 0.5 * most_ns
        self._late_ns = max(late_ns, kept_ns)
        self._plan, self._took_ns = plan, plan_ns
        self._begun_ns = plan_ns + self._late_ns - late_ns


class TimedGoal(NamedTuple):
    """Where to go, from when on, and when the watchdog brakes unless a chunk arrives."""

    goal: Goal
    plan: Plan
    rate_hz: float
    overdue_ns: int
    now_ns: int


class SpeedScaling:
    """Speed scaling: the share of its limits with which the arm moves to each goal.

    The least of what the time of the step asks for, of what slows the arm down and of what joints
    can follow, times the speed override.
    """

    def __init__(self) -> None:
        self.override = 1.0
        self.slowing = False
        """The arm may still be faster than the override allows."""
        self.slower: Slowdown | None = None
        """What reduces the speed to the goal, besides the override."""
        self.monitored: Slowdown | None = None
        """Of the monitors; it applies whatever the goal allows."""
        self.part_slowdown: Slowdown | None = None
        """Of the distance to another part of the robot."""
        self._slowed_by: set[str] = set()
        self._timings: dict[Mover, StepTiming] = {}
        """Since the arm stood."""

    def begin(self) -> None:
        """Start an activation."""
        self._slowed_by.clear()
        self.monitored = None

    def stand(self) -> None:
        """The arm stands, nothing was asked of it yet."""
        self._timings.clear()

    @property
    def share(self) -> float:
        """Share of the speed limits that slowdowns leave, without the override."""
        return 1.0 if self.slower is None else self.slower.share

    def slowest(self, goal: Goal) -> Slowdown | None:
        """What reduces the speed to `goal`."""
        return slowest(goal.slowdown, self.monitored, self.part_slowdown)

    def changes(self, mover: Mover, slower: Slowdown | None) -> bool:
        """Whether the motion in progress must be planned again, with `slower` from now on."""
        if self.slowing and _within(mover, self.override):
            return True
        return (1.0 if slower is None else slower.share) != self.share

    def go_to(self, mover: Mover, timed: TimedGoal, slower: Slowdown | None) -> list[Event]:
        """Carry out a goal; reports each reason for being `slower` once per activation."""
        self.slower, events = slower, list[Event]()
        if slower is not None and slower.name not in (APPROACH, *self._slowed_by):
            self._slowed_by.add(slower.name)
            name, _, value, limit, *_ = slower
            events.append(make_event("info", "limit", name, f"slower{slower.at}", value, limit))
        goal, plan, rate_hz, overdue_ns, now_ns = timed
        override, speed = self.override, self.share * self.override
        if not plan.soonest:
            timing = self._timings.setdefault(mover, StepTiming(mover.box))
            way, (velocity, _) = mover.way_to(goal), mover.axis_rates()
            index, left_s = plan.index_at(now_ns), (overdue_ns - now_ns) / 1e9
            share = timing.share(plan, index, now_ns, 1.0 / rate_hz, left_s, way, velocity)
            speed = min(speed, share)
        # The same motion in more time: acceleration scales with the square of the override, jerk
        # with the cube. Until a faster arm has slowed down it brakes as hard as it may.
        within = _within(mover, override)
        change, jerk = (override**2, override**3) if within else FULL[1:]
        shares = Shares(*map(min, mover.shares(goal), Shares(speed, change, jerk)))
        enough = mover.go_to(goal, shares, all_to_stop=self.slowing)
        # Planned with more than its share, it is planned again as soon as that suffices.
        faster = not within and (self.slowing or override < 1.0)
        self.slowing = faster or (self.slowing and not enough)
        return events


def _within(mover: Mover, override: float) -> bool:
    """Whether the arm moves as slowly as it would at this override, and will continue so.

    What still gets faster is planned within the override, whatever its acceleration: with all of
    the limits it could accelerate as at full speed. What slows down must be able to end that.
    """
    most = mover.box * override ** np.array([[1.0], [2.0], [3.0]])
    velocity, acceleration = mover.axis_rates()
    speed, change = np.abs(velocity), np.abs(acceleration)
    slows = velocity * acceleration < 0.0
    ends = (change <= most[1] * MIXED) & (speed + change**2 / (2 * most[2]) <= most[0] * MIXED)
    return bool(((speed <= most[0] * MIXED) & (ends | ~slows)).all())
