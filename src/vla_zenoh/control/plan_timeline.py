"""Action chunks as plans on a time axis: which goal was in force when.

A chunk whose observation was taken at ``t_o`` asks for waypoints ``W_1 .. W_H`` from ``t_1`` on::

    t_1 = t_o + idle(t_o, t_p)     idle: the time until its publication t_p in which no plan had a
                                   step left

    W_0 = G(t_o)                   what was asked for until the observation was taken,
                                   or the measured pose, see `ActionSpec.anchor`
    W_k = W_(k-1) o step_k         k = 1 .. H; or W_0 o step_k, see `ActionSpec.relative_to`
    in force at t: W_k, k = floor((t - t_1) / dt) + 1, at least 1 and at most H

    G(t) = W_s, s = (t - t_1) / dt, at most H, between two waypoints interpolated
    s    at least 1 for a chunk of one delta, see `least_steps`

Where a controller covers only a part of each step, its response is what is interpolated, and its
rate is part of W and G. Between chunks it stands still, as a simulator does during inference.

``G`` is the same function of every earlier plan. A plan is in force from the moment its chunk was
*published*: an observation taken later shows its effect, so the next delta stands on top of it; one
taken earlier does not, so the next delta replaces it. Nothing is counted twice and nothing is lost,
whatever the latency. Steps whose time has passed while an earlier plan ran are skipped, never
replayed: waypoints are sums, so skipping them loses no distance. While no plan runs the arm stands,
at the start or between chunks that are too short for their latency; none of the next chunk's steps
passes then, since its goal would run ahead of an arm which cannot be faster than its model asks.

Where plans overlap, the goal that is followed may be a blend of several (`PlanAggregator`); ``G``
is that of the newest plan in every mode.

A chunk that is replaced counts for the time it had, be that less than a step: the speed a model
asks for does not depend on how often it is asked. A chunk of one delta is a step, however soon the
next one comes. Steps are counted in the same way: a plan starts with the number that its ``W_0``
stands for.

All of this is in plan time, which is wall time while the speed override is 100 %. At an override of
share ``s`` plan time passes ``s`` times as fast: each step takes ``dt / s``, and the goals are the
same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from vla_zenoh.control.actions import Response, between
from vla_zenoh.control.limits import Slowdown, into_workspace, slowest
from vla_zenoh.kinematics.so3 import Pose, interpolate, mean_pose, orthonormal
from vla_zenoh.policy.plan_clock import HISTORY_NS, PlanClock, idle_time
from vla_zenoh.profile import Composition, Limits
from vla_zenoh.types import Cause, FloatArray

if TYPE_CHECKING:
    from vla_zenoh.kinematics.kinematics import Kinematics

WHOLE_STEP = 1e-6
"""Parts of steps that add up to one within this are a whole step."""


WALL_CLOCK = PlanClock()
"""Plan time without a speed override."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A waypoint: TCP pose and gripper width; `JointGoal` is one of joints.

    Args:
        joints_rad: (n,) a joint solution of the pose; None: not computed.
        slowdown: why the arm moves there slower than at full speed.
        response: state there of a controller that covers only a part of each step; None: without.
    """

    pose: Pose
    width_m: float
    joints_rad: FloatArray | None = None
    slowdown: Slowdown | None = None
    response: Response | None = None

    @property
    def known_rad(self) -> FloatArray:
        """(n,) its joints, where they are known."""
        assert self.joints_rad is not None
        return self.joints_rad

    def between(self, coming: Goal, share: float, dt_s: float = 0.0) -> Goal:
        """The goal after `share` of a step of `dt_s` to `coming`, in the space asked for there."""
        return coming.reached_from(self, share, dt_s)

    def reached_from(self, start: Goal, share: float, dt_s: float) -> Goal:
        """The goal after `share` of a step of `dt_s` from `start` to this one."""
        width_m = start.width_m + share * (self.width_m - start.width_m)
        if self.response is None or dt_s == 0.0:
            return Goal(interpolate(start.pose, self.pose, share), width_m)
        pose, state = between(start.pose, self.pose, self.response, dt_s, share)
        return Goal(pose, width_m, response=state)

    def shifted(self, old: Goal, new: Goal, limits: Limits) -> Goal:
        """This goal after what moves `old` to `new`, within the workspace box."""
        way_m = new.pose.position_m - old.pose.position_m
        turn = old.pose.rotation.T @ new.pose.rotation
        inside, _ = into_workspace(limits, self.pose.position_m + way_m, self.pose.position_m)
        moved = Pose(inside, orthonormal(self.pose.rotation @ turn))
        return Goal(moved, self.width_m, response=self.response)

    def mean(self, goals: Sequence[Goal], weights: FloatArray) -> Goal:
        """Weighted mean of goals in the space of this one, with its width."""
        return Goal(mean_pose([goal.pose for goal in goals], weights), self.width_m)


@dataclass(frozen=True, slots=True)
class JointGoal(Goal):
    """A waypoint of the joints `joints_rad` (n,) in chain order; `arm` makes its pose of them."""

    joints_rad: FloatArray = field(kw_only=True)
    arm: Kinematics = field(kw_only=True)

    def reached_from(self, start: Goal, share: float, dt_s: float) -> Goal:
        if start.joints_rad is None:
            return Goal.reached_from(self, start, share, dt_s)
        way_rad = self.joints_rad - start.joints_rad
        width_m = start.width_m + share * (self.width_m - start.width_m)
        return joint_goal(self.arm, start.joints_rad + share * way_rad, width_m)

    def shifted(self, old: Goal, new: Goal, limits: Limits) -> Goal:
        way_rad = new.known_rad - old.known_rad
        return joint_goal(self.arm, self.joints_rad + way_rad, self.width_m)

    def mean(self, goals: Sequence[Goal], weights: FloatArray) -> Goal:
        joints = [goal.joints_rad for goal in goals if goal.joints_rad is not None]
        if len(joints) < len(goals):
            return Goal.mean(self, goals, weights)
        return joint_goal(self.arm, weights / weights.sum() @ np.array(joints), self.width_m)


def joint_goal(
    arm: Kinematics, joints_rad: FloatArray, width_m: float, slowdown: Slowdown | None = None
) -> JointGoal:
    """The goal of these joints (n,) in chain order."""
    pose = arm.forward(joints_rad)
    return JointGoal(pose, width_m, slowdown=slowdown, joints_rad=joints_rad, arm=arm)


@dataclass(slots=True)
class Plan:
    """Goals on a time axis.

    Args:
        effective_ns: in force from this time on.
        start_ns: time of the observation.
        dt_ns: duration of a step.
        goals: one per step.
        cause: the chunk it was made from, None for a hold.
        bounded: number of goals known to be within what the arm can do, by default all; the last of
            them stays in force, and is all that was asked for, until the next one is bounded.
        computed: number of goals computed; the others are placeholders until they come due.
        steps_before: steps of the episode asked for until its observation was taken.
        steps_total: steps of the episode, as far as the policy has ended it.
        done: the policy reports that these steps are the last.
        clock: plan time. `dt_ns` is in plan time, the other times are wall time.
        soonest: the arm moves to each goal as fast as it can, and waits there for the next one.
        idle_ns: plan time from the observation to the window of the first step, in which no plan
            ran.
        begin: the goal from which the first step counts by its time; None: it counts as a whole.
    """

    effective_ns: int
    start_ns: int
    dt_ns: int
    goals: list[Goal]
    cause: Cause | None = None
    bounded: int = -1
    episode: int = 0
    steps_before: float = 0.0
    steps_total: float = math.inf
    done: bool = False
    arrival_ns: int = 0
    computed: int = -1
    clock: PlanClock = WALL_CLOCK
    soonest: bool = False
    idle_ns: int = 0
    begin: Goal | None = None
    _start_ns: int = field(init=False)  # in plan time

    def __post_init__(self) -> None:
        self.run_on(self.clock)
        if self.bounded < 0:
            self.bounded = self.computed = len(self.goals)

    def run_on(self, clock: PlanClock) -> None:
        """Run on this clock, which remembers the time of the observation now, and not for long."""
        self.clock, self._start_ns = clock, clock.at(self.start_ns) + self.idle_ns

    def elapsed_ns(self, t_ns: int) -> int:
        """Plan time from the begin of the first step to `t_ns`."""
        return self.clock.at(t_ns) - self._start_ns

    def due_index(self, t_ns: int) -> int:
        """Index of the step that is due at `t_ns`."""
        return min(max(self.elapsed_ns(t_ns) // self.dt_ns, 0), len(self.goals) - 1)

    def index_at(self, t_ns: int) -> int:
        """Index of the step in force at `t_ns`: the one due, or the last one bounded."""
        return min(self.due_index(t_ns), self.bounded - 1)

    def goal_at(self, t_ns: int) -> Goal:
        """G(t): what its steps have asked for until `t_ns`."""
        least_ns = self.dt_ns if self.begin is None else 0
        done, part_ns = divmod(max(self.elapsed_ns(t_ns), least_ns), self.dt_ns)
        if done >= self.bounded or (done and part_ns == 0):
            return self.goals[min(done, self.bounded) - 1]
        before = self.goals[done - 1] if done else self.begin
        assert before is not None  # it counts as a whole, so done is 1 at least
        return before.between(self.goals[done], part_ns / self.dt_ns, self.dt_ns / 1e9)

    def steps_until(self, t_ns: int) -> float:
        """Steps of the episode asked for until `t_ns`, including parts of one."""
        elapsed, least = self.elapsed_ns(t_ns) / self.dt_ns, 1.0 if self.begin is None else 0.0
        return min(self.steps_before + min(max(elapsed, least), self.bounded), self.steps_total)

    def steps_in_force(self, t_ns: int) -> float:
        """Steps of the episode in force until `t_ns`, the present one as a whole."""
        return min(self.steps_before + self.index_at(t_ns) + 1, self.steps_total)

    @property
    def end_ns(self) -> int:
        """End of the last step, at the present override."""
        return self.clock.wall_at(self._start_ns + len(self.goals) * self.dt_ns)

    @property
    def run_ns(self) -> tuple[int, int]:
        """When it comes into force and when its last step ends, in plan time; a hold has none."""
        begin_ns = self.clock.at(self.effective_ns)
        if self.cause is None:
            return begin_ns, begin_ns
        return begin_ns, self._start_ns + len(self.goals) * self.dt_ns

    def left_ns(self, t_ns: int) -> int:
        """Plan time from `t_ns` to the end of the last step."""
        return max(len(self.goals) * self.dt_ns - self.elapsed_ns(t_ns), 0)

    def shift(self, index: int, old: Goal, new: Goal, limits: Limits) -> None:
        """Shift the goals from `index` on as from `old` to `new`, within the workspace box."""
        # They are elsewhere than checked: bounded again when due. Goal 0 has none before it.
        self.bounded = min(self.bounded, max(index, 1))
        for later in range(index, self.computed):
            self.goals[later] = self.goals[later].shifted(old, new, limits)

    def shift_rest(self, index: int, goal: Goal, limits: Limits) -> None:
        """Replace goal `index`, and shift the later ones with it."""
        self.shift(index + 1, self.goals[index], goal, limits)
        self.goals[index] = goal


class GoalTimeline:
    """All plans of the last `HISTORY_NS`, the newest last."""

    def __init__(self, goal: Goal, now_ns: int) -> None:
        self.clock = PlanClock()
        self._plans: list[Plan] = []
        self.hold(goal, now_ns)

    def hold(self, goal: Goal, now_ns: int) -> None:
        """Stand at `goal` from now on."""
        hold = Plan(now_ns, now_ns, 1_000_000_000, [goal])
        if self._plans:
            last = self.plan
            hold.episode, hold.done = last.episode, last.done
            hold.steps_before = hold.steps_total = last.steps_until(now_ns)
        self.add(hold, now_ns)

    def restart(self, goal: Goal, now_ns: int) -> None:
        """Drop all plans and stand at `goal`."""
        self.clock = PlanClock(self.clock.override, now_ns)
        self._plans.clear()
        self.hold(goal, now_ns)

    def add(self, plan: Plan, now_ns: int) -> None:
        """Put `plan` in force, not before the newest plan and not after now."""
        earliest = self._plans[-1].effective_ns if self._plans else plan.effective_ns
        plan.effective_ns = max(earliest, min(plan.effective_ns, now_ns))
        plan.arrival_ns = now_ns
        plan.run_on(self.clock)
        self._plans.append(plan)
        while len(self._plans) > 1 and self._plans[1].effective_ns < now_ns - HISTORY_NS:
            del self._plans[0]

    @property
    def plan(self) -> Plan:
        """The newest plan."""
        return self._plans[-1]

    def episode_plans(self) -> Iterator[Plan]:
        """The newest plan, then older ones of its episode back to the last hold."""
        newest = self.plan
        yield newest
        for plan in reversed(self._plans[:-1]):
            if newest.cause is None or plan.cause is None or plan.episode != newest.episode:
                return
            yield plan

    def in_force(self, t_ns: int) -> Plan:
        """The newest plan that was in force at `t_ns`."""
        in_force = (plan for plan in reversed(self._plans) if plan.effective_ns <= t_ns)
        return next(in_force, self._plans[0])

    def idle_ns(self, begin_ns: int, end_ns: int) -> int:
        """Plan time between two wall times in which no plan of a chunk ran."""
        runs = [plan.run_ns for plan in self._plans]
        return round(idle_time(self.clock.at(begin_ns), self.clock.at(end_ns), runs))

    def at(self, t_ns: int) -> Goal:
        """G(t) of the plan that was in force at `t_ns`."""
        return self.in_force(t_ns).goal_at(t_ns)


@dataclass(slots=True)
class EpisodeProgress:
    """Progress of an episode: `chunks` accepted, `steps` in force, and `done` by the policy."""

    chunks: int = 0
    steps: int = 0
    done: bool = False

    def update(self, timeline: GoalTimeline, episode: int, now_ns: int) -> None:
        """Count the steps in force, and see whether they were the last ones."""
        plan = timeline.plan
        if plan.episode != episode:
            return
        self.steps = max(self.steps, math.floor(plan.steps_in_force(now_ns) + WHOLE_STEP))
        self.done = plan.done and plan.index_at(now_ns) == len(plan.goals) - 1


class PlanAggregator:
    """The goal F(t) of overlapping plans on a timeline: the newest's, a blend, or an ensemble.

    ``P_i(t)`` is the waypoint of plan i at time t, i = 0 the oldest::

        replace    F(t) = P_n(t), n the newest
        blend      F(t) = mix(F'(t), P_n(t), w(s)), F' the same over the plans before it,
                   w(s) = s^3 (10 - 15 s + 6 s^2), s = (t - a) / T
        ensemble   F(t) = sum_i w_i P_i(t) / sum_i w_i, w_i = exp(-m i), over the plans alive at t

    ``a`` is the arrival of plan n, ``T`` the profile's `blend_s`, or less where the plan before it
    ends sooner: only what overlaps is blended. A plan is alive until the end of its last step; the
    newest always is. A mix of two poses is linear in position and on the geodesic in rotation; the
    mean of several is `mean_pose`. The width is the newest's.

    Only plans of one episode since the last hold are mixed: a new prompt counts at once.

    In every mode a later chunk builds on ``G(t)`` of the newest plan alone: that is the request,
    the mode only decides how to get there. So no step is lost or counted twice, and once the last
    plan is alone the goal is exactly where its steps end. ``F`` lies between bounded goals, and
    inside the workspace, which is convex.

    Source of the ensemble: Zhao, Kumar, Levine, Finn, "Learning Fine-Grained Bimanual Manipulation
    with Low-Cost Hardware", RSS 2023 (temporal ensembling; m = 0.01 there).

    Args:
        composition: the mode and its parameters.
    """

    def __init__(self, composition: Composition) -> None:
        self._mode = composition.mode
        self._blend_ns = round(composition.blend_s * 1e9)
        self._max_plans = composition.ensemble_plans
        self._weights = np.exp(-composition.ensemble_decay * np.arange(self._max_plans))
        self._mean: tuple[list[Goal], Goal] | None = None

    def plans(self, timeline: GoalTimeline, now_ns: int) -> list[Plan]:
        """The plans that F(now) depends on, the newest last."""
        if self._mode == "replace":
            return [timeline.plan]
        episode_plans = timeline.episode_plans()
        newest = next(episode_plans)
        if self._mode == "blend":
            plans = [newest]
            for older in episode_plans:
                if self._weight(older, plans[-1], now_ns) >= 1.0:
                    break
                plans.append(older)
            return plans[::-1]
        alive = [plan for plan in episode_plans if now_ns < plan.end_ns]
        return [newest, *alive[: self._max_plans - 1]][::-1]

    def goal(self, plans: Sequence[Plan], now_ns: int) -> Goal:
        """F(t) of `plans`; of a single plan, its own waypoint."""
        waypoints = [plan.goals[plan.index_at(now_ns)] for plan in plans]
        if len(plans) == 1:
            return waypoints[0]
        if self._mode == "blend":
            mixed = waypoints[0]
            for older, plan, waypoint in zip(plans, plans[1:], waypoints[1:], strict=False):
                mixed = mixed.between(waypoint, self._weight(older, plan, now_ns))
            return _with_rest(mixed, waypoints)
        known = self._mean
        if known is None or [*map(id, known[0])] != [*map(id, waypoints)]:
            weights = self._weights[: len(waypoints)]
            mean = _with_rest(waypoints[-1].mean(waypoints, weights), waypoints)
            known = self._mean = waypoints, mean
        return known[1]

    def _weight(self, older: Plan, plan: Plan, now_ns: int) -> float:
        """Share of `plan` against `older`: 0 when it arrives, 1 at the end of its window."""
        elapsed_ns = plan.elapsed_ns(now_ns) - plan.elapsed_ns(plan.arrival_ns)
        left_ns = len(older.goals) * older.dt_ns - older.elapsed_ns(plan.arrival_ns)
        window_ns = min(self._blend_ns, left_ns)
        if elapsed_ns >= window_ns:
            return 1.0
        s = max(elapsed_ns, 0) / window_ns
        return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _with_rest(mixed: Goal, waypoints: Sequence[Goal]) -> Goal:
    """A mix of `waypoints`, with the newest width and the least speed of them."""
    slower = slowest(*(goal.slowdown for goal in waypoints))
    return replace(mixed, width_m=waypoints[-1].width_m, slowdown=slower)
