"""Aggregation of overlapping plans: the newest plan, a blend, or an ensemble.

``P_i(t)`` is the waypoint of plan i at time t, i = 0 the oldest::

    replace    F(t) = P_n(t), n the newest
    blend      F(t) = mix(F'(t), P_n(t), w(s)), F' the same over the plans before it,
               w(s) = s^3 (10 - 15 s + 6 s^2), s = (t - a) / T
    ensemble   F(t) = sum_i w_i P_i(t) / sum_i w_i, w_i = exp(-m i), over the plans alive at t

``a`` is the arrival of plan n, ``T`` the profile's `blend_s`, or less where the plan before it ends
sooner: only what overlaps is blended. A plan is alive until the end of its last step; the newest
always is. A mix of two poses is linear in position and on the geodesic in rotation; the mean of
several rotations is that on SO(3), ``sum_i w_i log(R_i R^T) = 0``. The width is the newest's.

Only plans of one episode since the last hold are mixed: a new prompt counts at once.

In every mode a later chunk builds on ``G(t)`` of the newest plan alone: that is the request, the
mode only decides how to get there. So no step is lost or counted twice, and once the last plan is
alone the goal is exactly where its steps end. ``F`` lies between bounded goals, and inside the
workspace, which is convex.

Source of the ensemble: Zhao, Kumar, Levine, Finn, "Learning Fine-Grained Bimanual Manipulation with
Low-Cost Hardware", RSS 2023 (temporal ensembling; m = 0.01 there).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vla_zenoh.control.limits import slowest
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan, joint_goal
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, norm3, orthonormal
from vla_zenoh.profile import Composition
from vla_zenoh.types import FloatArray

MEAN_ITERATIONS = 10
MEAN_RAD = 1e-10
"""The mean of rotations has converged when it moves by less."""


class PlanAggregator:
    """The goal F(t) of the plans on a timeline, by one of the three modes.

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
        if self._mode == "blend":
            return self._blended(timeline, now_ns)
        newest, *older = timeline.episode_plans()
        alive = [plan for plan in older if now_ns < plan.end_ns]
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
            mean = _with_rest(_mean_goal(waypoints, self._weights), waypoints)
            known = self._mean = waypoints, mean
        return known[1]

    def _blended(self, timeline: GoalTimeline, now_ns: int) -> list[Plan]:
        episode_plans = timeline.episode_plans()
        plans = [next(episode_plans)]
        for older in episode_plans:
            if self._weight(older, plans[-1], now_ns) >= 1.0:
                break
            plans.append(older)
        return plans[::-1]

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


def _mean_goal(goals: Sequence[Goal], weights: FloatArray) -> Goal:
    """Weighted mean of goals, in the space (poses or joints) of the last of them."""
    last, weights = goals[-1], weights[: len(goals)]
    joints = [goal.joints_rad for goal in goals if goal.joints_rad is not None]
    if last.arm is None or len(joints) < len(goals):
        return Goal(mean_pose([goal.pose for goal in goals], weights), last.width_m)
    return joint_goal(last.arm, weights / weights.sum() @ np.array(joints), last.width_m)


def mean_pose(poses: Sequence[Pose], weights: FloatArray) -> Pose:
    """Weighted mean of poses: in R^3, and on SO(3) (Karcher mean, iterated from the last one).

    Args:
        poses: rotations less than half a turn apart.
        weights: (n,) not negative, not all zero.
    """
    shares = weights / weights.sum()
    position_m = shares @ np.array([pose.position_m for pose in poses])
    rotation = poses[-1].rotation
    for _ in range(MEAN_ITERATIONS):
        turn = shares @ np.array([log3(pose.rotation @ rotation.T) for pose in poses])
        rotation = exp3(turn) @ rotation
        if norm3(turn) < MEAN_RAD:
            break
    return Pose(position_m, orthonormal(rotation))
