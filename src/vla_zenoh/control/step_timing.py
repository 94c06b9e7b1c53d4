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
alpha-beta filter), ``spare`` twice their mean deviation from it: what an inference takes varies.

Only the speed is bounded by this. Which goal is in force when, and where the arm ends, are those of
`vla_zenoh.control.plan_timeline`.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from vla_zenoh.control.plan_timeline import Plan
from vla_zenoh.types import FloatArray

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
SLOWEST = 1e-3
"""Least share of the velocity limits."""
SOON_NS = 1_000_000
MARGIN_NS = 10_000_000
EASING = 0.1
"""Part of the time by which what is kept in reserve may change; half of it how late the arm is."""


class Arrivals:
    """When the next chunk is expected, in plan time."""

    def __init__(self) -> None:
        self._last_ns: float | None = None
        self._period_ns = self._deviation_ns = 0.0
        self._intervals = 0

    def arrived(self, now_ns: int, asked_period_ns: float) -> None:
        """A chunk arrived, of a worker that is asked for one in every `asked_period_ns`."""
        if self._last_ns is None:
            self._last_ns, self._period_ns = now_ns, asked_period_ns
            self._deviation_ns = FIRST_DEVIATION * asked_period_ns
            return
        self._intervals += 1
        expected_ns = self._last_ns + self._period_ns
        late_ns, half_ns = now_ns - expected_ns, 0.5 * self._period_ns
        # The first intervals weigh most: a slow model is asked less often than requested.
        phase, period = max(PHASE, 1 / self._intervals), max(PERIOD, 1 / self._intervals)
        self._last_ns = min(max(expected_ns + phase * late_ns, now_ns - half_ns), now_ns + half_ns)
        self._period_ns = max(self._period_ns + period * late_ns, 0.5 * asked_period_ns)
        self._deviation_ns += DEVIATION * (abs(late_ns) - self._deviation_ns)

    @property
    def next_ns(self) -> float:
        """When the next chunk is expected; the beginning of time before the first one."""
        return -math.inf if self._last_ns is None else self._last_ns + self._period_ns

    @property
    def spare_ns(self) -> float:
        """How much later than that it may well be."""
        return SPARE * self._deviation_ns


class StepTiming:
    """The speed to each goal.

    Args:
        box: (3, 6) velocity, acceleration and jerk limits of every axis.
    """

    def __init__(self, box: FloatArray) -> None:
        self._box = box
        self.restart()

    def restart(self) -> None:
        """The arm stands, nothing was asked of it yet."""
        self._arrivals = Arrivals()
        self._plan: Plan | None = None
        self._took_ns = 0
        self._begun_ns = self._late_ns = 0.0
        self._gone = self._stretch = self._spare_ns = 0.0

    def fork(self) -> StepTiming:
        """A copy that goes on by itself."""
        fork = copy(self)
        fork._arrivals = copy(self._arrivals)
        return fork

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
            stop_s = _stop_s(min(share, 1.0), most, jerk)
            share = length / (time_s + 0.5 * stop_s)
            least = length / max(left_s - 0.6 * stop_s, 1e-3)
        if MOVING * share < now:
            share = now + CHANGE * (share - now)
        share = max(share, least)
        return min(max(share, SLOWEST), 1.0)

    def _take(self, plan: Plan, plan_ns: int, asked_period_s: float) -> None:
        self._arrivals.arrived(plan_ns, asked_period_s * 1e9)
        steps, before = len(plan.goals), self._plan
        self._gone = 0.0
        if before is not None:
            now_ns = plan.clock.wall_at(plan_ns)
            asked = before.steps_until(now_ns) - before.steps_until(plan.start_ns)
            self._gone = min(max(asked * before.dt_ns / plan.dt_ns, 0.0), steps - 1.0)
        lasts_ns = (steps - self._gone) * plan.dt_ns
        wait_ns = max(self._arrivals.next_ns - plan_ns, 0.0)
        self._stretch = max(1.0, wait_ns / lasts_ns)
        covered_ns = lasts_ns * self._stretch - wait_ns
        spare_ns = MARGIN_NS + max(0.0, self._arrivals.spare_ns - covered_ns)
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


def _stop_s(speed: float, most: float, jerk: float) -> float:
    """How long a stop takes from constant `speed`, within an acceleration and a jerk."""
    if speed * jerk < most * most:
        return 2.0 * math.sqrt(speed / jerk)
    return speed / most + most / jerk
