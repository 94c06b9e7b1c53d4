"""Which goal was in force when: chunks as plans on a time axis.

A chunk whose observation was taken at ``t_o`` asks for waypoints ``W_1 .. W_H``::

    W_0 = G(t_o)                   what was asked for until the observation was taken
    W_k = W_(k-1) o step_k         k = 1 .. H
    in force at t: W_k, k = floor((t - t_o) / dt) + 1, at least 1 and at most H

    G(t) = W_s, s = (t - t_o) / dt, at least 1 and at most H, between two waypoints interpolated

``G`` is the same function of every plan before it. A plan is in force from the moment its chunk was
*published*: an observation taken later shows its effect, so the next delta stands on top of it; one
taken earlier does not, so the next delta replaces it. Nothing is counted twice and nothing is lost,
whatever the latency. Steps whose time has passed when a chunk arrives are skipped, never replayed:
waypoints are sums, so skipping them loses no way.

In overlapping plans the goal that is followed may be a blend of several, see
`vla_zenoh.control.aggregate`; ``G`` is that of the newest one in every mode.

A chunk that is replaced half-way counts for the time it had, and for its first step at least: the
speed a model asks for is the speed it gets however often it is asked, and a single step is a step.
Steps are counted in the same way: a plan begins with as many as its ``W_0`` stands for.

All of this is in plan time, which is the wall time while the speed override is 100 %. At a share
``s`` of it plan time passes ``s`` times as fast: each step takes ``dt / s``, and the goals are the
same ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from vla_zenoh.control.limits import Slowdown, into_workspace
from vla_zenoh.kinematics.so3 import Pose, interpolate, orthonormal
from vla_zenoh.profile import Limits
from vla_zenoh.types import Cause, FloatArray

HISTORY_NS = 15_000_000_000
"""Observations are refused long before they are this old."""
OVERRIDES_NS = 600_000_000_000
"""A slow plan lasts long: how long changes of the override are remembered."""
FOREVER_NS = 1 << 62
WHOLE_STEP = 1e-6
"""Parts of steps that sum up to all but this are a step."""


class PlanClock:
    """Plan time as a function of wall time (both ns): it passes at the speed override's share."""

    def __init__(self) -> None:
        self._marks: list[tuple[int, int, float]] = [(0, 0, 1.0)]

    @property
    def override(self) -> float:
        """Plan seconds per second of the wall clock, 0 to 1."""
        return self._marks[-1][2]

    def set(self, override: float, now_ns: int) -> None:
        """From `now_ns` on plan time passes at this share."""
        self._marks.append((now_ns, self.at(now_ns), override))
        while len(self._marks) > 1 and self._marks[1][0] < now_ns - OVERRIDES_NS:
            del self._marks[0]

    def at(self, wall_ns: int) -> int:
        """Plan time at a wall time of the last seconds, or to come at the present share."""
        marks = (mark for mark in reversed(self._marks) if mark[0] <= wall_ns)
        since_ns, plan_ns, override = next(marks, self._marks[0])
        passed_ns = wall_ns - since_ns
        return plan_ns + (passed_ns if override == 1.0 else round(override * passed_ns))

    def wall_at(self, plan_ns: int) -> int:
        """Wall time when plan time will be `plan_ns`; far away while plan time stands still."""
        since_ns, base_ns, override = self._marks[-1]
        if override <= 0.0:
            return FOREVER_NS
        return since_ns + round((plan_ns - base_ns) / override)


WALL_CLOCK = PlanClock()
"""Plan time of whoever has no speed override."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A TCP pose and a gripper width (m) to go to.

    Args:
        pose: of the TCP.
        width_m: of the gripper.
        joints_rad: (n,) a joint solution of the pose, where one was looked for.
        slowdown: why the arm goes there slower than at full speed.
    """

    pose: Pose
    width_m: float
    joints_rad: FloatArray | None = None
    slowdown: Slowdown | None = None


@dataclass(slots=True)
class Plan:
    """Goals on a time axis.

    Args:
        effective_ns: in force from this time on.
        start_ns: time of the observation; the first step's window begins here.
        dt_ns: length of a step's window.
        goals: one per step.
        cause: the chunk it came from, None for a hold.
        bounded: so many of the goals are known to be within what the arm can do, by default all;
            the last of them stays in force, and is all that was asked for, until the next one is.
        made: so many of the goals are made at all; the others stand for steps that are looked at
            when they come due.
        episode: the chunk's.
        begun: steps of the episode that had been asked for when its observation was taken.
        most: steps of the episode that there are at all, as far as the policy has said.
        done: the policy says that these steps are the last.
        arrival_ns: when the chunk arrived.
        clock: plan time. `dt_ns` is in plan time, the other times are of the wall.
        soonest: the arm goes to each goal as fast as it can, and waits there for the next one.
    """

    effective_ns: int
    start_ns: int
    dt_ns: int
    goals: list[Goal]
    cause: Cause | None = None
    bounded: int = -1
    episode: int = 0
    begun: float = 0.0
    most: float = math.inf
    done: bool = False
    arrival_ns: int = 0
    made: int = -1
    clock: PlanClock = WALL_CLOCK
    soonest: bool = False

    def __post_init__(self) -> None:
        if self.bounded < 0:
            self.bounded = self.made = len(self.goals)

    def elapsed_ns(self, t_ns: int) -> int:
        """Plan time from the observation to `t_ns`."""
        return self.clock.at(t_ns) - self.clock.at(self.start_ns)

    def due_index(self, t_ns: int) -> int:
        """Index of the step whose time it is at `t_ns`."""
        return min(max(self.elapsed_ns(t_ns) // self.dt_ns, 0), len(self.goals) - 1)

    def index_at(self, t_ns: int) -> int:
        """Index of the step in force at `t_ns`: that one, or the last that is bounded."""
        return min(self.due_index(t_ns), self.bounded - 1)

    def goal_at(self, t_ns: int) -> Goal:
        """What its steps have asked for until `t_ns`, its first step at least."""
        done, part_ns = divmod(self.elapsed_ns(t_ns), self.dt_ns)
        if done < 1:
            return self.goals[0]
        if done >= self.bounded or part_ns == 0:
            return self.goals[min(done, self.bounded) - 1]
        last, coming, share = self.goals[done - 1], self.goals[done], part_ns / self.dt_ns
        return Goal(
            interpolate(last.pose, coming.pose, share),
            last.width_m + share * (coming.width_m - last.width_m),
        )

    def steps_until(self, t_ns: int) -> float:
        """Steps of the episode that have been asked for until `t_ns`, parts of one included."""
        had = self.elapsed_ns(t_ns) / self.dt_ns
        return min(self.begun + min(max(had, 1.0), self.bounded), self.most)

    def steps_in_force(self, t_ns: int) -> float:
        """Likewise those that have come in force, the present one as a whole."""
        return min(self.begun + self.index_at(t_ns) + 1, self.most)

    @property
    def end_ns(self) -> int:
        """End of the last step's window, at the present override."""
        end_ns = self.clock.at(self.start_ns) + len(self.goals) * self.dt_ns
        return self.clock.wall_at(end_ns)

    def shift(self, index: int, way_m: FloatArray, turn: FloatArray, limits: Limits) -> None:
        """Move the goals from `index` on; what leaves the workspace stays at its border."""
        # Elsewhere than checked: looked at again when they come due. Goal 0 has none before it.
        self.bounded = min(self.bounded, max(index, 1))
        for later in range(index, self.made):
            goal = self.goals[later]
            inside, _ = into_workspace(limits, goal.pose.position_m + way_m, goal.pose.position_m)
            turned = orthonormal(goal.pose.rotation @ turn)
            self.goals[later] = Goal(Pose(inside, turned), goal.width_m)

    def shift_rest(self, index: int, goal: Goal, limits: Limits) -> None:
        """Replace goal `index`, moving the later ones along with it."""
        old = self.goals[index].pose
        way_m = goal.pose.position_m - old.position_m
        self.shift(index + 1, way_m, old.rotation.T @ goal.pose.rotation, limits)
        self.goals[index] = goal


class GoalTimeline:
    """All plans of the last seconds."""

    def __init__(self, goal: Goal, now_ns: int) -> None:
        self.clock = PlanClock()
        self._plans: list[Plan] = []
        self.hold(goal, now_ns)

    def hold(self, goal: Goal, now_ns: int) -> None:
        """From now on the goal is to stand at `goal`."""
        hold = Plan(now_ns, now_ns, 1_000_000_000, [goal])
        if self._plans:
            last = self.plan
            hold.episode, hold.done = last.episode, last.done
            hold.begun = hold.most = last.steps_until(now_ns)
        self.add(hold, now_ns)

    def restart(self, goal: Goal, now_ns: int) -> None:
        """Forget everything and stand at `goal`."""
        self._plans.clear()
        self.hold(goal, now_ns)

    def add(self, plan: Plan, now_ns: int) -> None:
        """Put `plan` in force, not before what is there already and not after now."""
        earliest = self._plans[-1].effective_ns if self._plans else plan.effective_ns
        plan.effective_ns = max(earliest, min(plan.effective_ns, now_ns))
        plan.arrival_ns, plan.clock = now_ns, self.clock
        self._plans.append(plan)
        while len(self._plans) > 1 and self._plans[1].effective_ns < now_ns - HISTORY_NS:
            del self._plans[0]

    @property
    def plan(self) -> Plan:
        """The newest plan."""
        return self._plans[-1]

    def episode_plans(self) -> Iterator[Plan]:
        """The newest plan, then older ones of the same episode back to a hold, which is none."""
        newest = self.plan
        yield newest
        for plan in reversed(self._plans[:-1]):
            if newest.cause is None or plan.cause is None or plan.episode != newest.episode:
                return
            yield plan

    def in_force(self, t_ns: int) -> Plan:
        """The newest plan that was in force at `t_ns`."""
        for plan in reversed(self._plans):
            if plan.effective_ns <= t_ns:
                return plan
        return self._plans[0]

    def at(self, t_ns: int) -> Goal:
        """G(t): what the plan that was in force at `t_ns` had asked for by then."""
        return self.in_force(t_ns).goal_at(t_ns)


class EpisodeProgress:
    """See the module. `chunks` that were accepted, `steps` of them that came in force."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """An episode begins."""
        self.chunks = self.steps = 0
        self.done = False

    def look(self, timeline: GoalTimeline, episode: int, now_ns: int) -> None:
        """Steps that have come in force, and whether they were the last ones."""
        plan = timeline.plan
        if plan.episode != episode:
            return
        steps = math.floor(plan.steps_in_force(now_ns) + WHOLE_STEP)
        self.steps = max(self.steps, steps)
        self.done = plan.done and plan.index_at(now_ns) == len(plan.goals) - 1
