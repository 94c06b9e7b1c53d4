"""Overlapping plans: what is followed in each mode, and that it ends where the newest one ends."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan, PlanAggregator
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3, interpolate, mean_pose
from vla_zenoh.profile import Composition
from vla_zenoh.types import Cause

MS = 1_000_000
DT_NS = 100 * MS
STEP_M, STEP_RAD = 0.01, 0.05
ATOL_M, ATOL_RAD = 1e-9, 1e-7
BLEND_S = 0.2
MODES = st.sampled_from(["replace", "blend", "ensemble"])
REQUESTS = st.lists(st.tuples(st.integers(1, 300), st.integers(0, 200)), min_size=1, max_size=15)


def aggregator(mode: str, **numbers: float) -> PlanAggregator:
    return PlanAggregator(Composition.model_validate({"mode": mode, "blend_s": BLEND_S, **numbers}))


def at(height_m: float, yaw_rad: float = 0.0, width_m: float = 0.08) -> Goal:
    return Goal(Pose(np.array([0.4, 0.0, height_m]), exp3(np.array([0, 0, yaw_rad]))), width_m)


def plan(start_ms: int, goals: list[Goal], episode: int = 1) -> Plan:
    cause = Cause("w", 0, start_ms, start_ms, start_ms, start_ms, start_ms, start_ms)
    return Plan(start_ms * MS, start_ms * MS, DT_NS, goals, cause, episode=episode)


def rising(before: Goal, steps: int) -> list[Goal]:
    height_m = float(before.pose.position_m[2])
    return [at(height_m + (k + 1) * STEP_M, (k + 1) * STEP_RAD) for k in range(steps)]


def goal(how: PlanAggregator, timeline: GoalTimeline, now_ns: int) -> Goal:
    return how.goal(how.plans(timeline, now_ns), now_ns)


def height(of: Goal) -> float:
    return float(of.pose.position_m[2])


def two_plans() -> GoalTimeline:
    """One that stays at 0.30 m, and one from 100 ms on that stays at 0.34 m and 0.4 rad."""
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(plan(0, [at(0.3, width_m=0.02)] * 10), 0)
    timeline.add(plan(100, [at(0.34, 0.4, 0.06)] * 10), 100 * MS)
    return timeline


@settings(max_examples=60, deadline=None)
@given(MODES, st.integers(1, 12), REQUESTS)
def test_in_any_mode_the_goal_ends_where_the_newest_plan_ends(
    mode: str, horizon: int, requests: list[tuple[int, int]]
) -> None:
    how, timeline, now_ns = aggregator(mode), GoalTimeline(at(0.0), 0), 0
    for wait_ms, latency_ms in requests:
        observed_ns = now_ns + wait_ms * MS
        made = plan(observed_ns // MS, rising(timeline.at(observed_ns), horizon))
        now_ns = observed_ns + latency_ms * MS
        made.effective_ns = now_ns
        timeline.add(made, now_ns)
        followed = goal(how, timeline, now_ns)
        assert height(followed) <= height(timeline.plan.goals[-1]) + ATOL_M
    end_ns = now_ns + round((horizon * 0.1 + BLEND_S) * 1e9)
    assert goal(how, timeline, end_ns) is timeline.plan.goals[-1]


def test_a_blend_moves_over_smoothly_within_its_window_and_takes_the_new_width_at_once() -> None:
    how, timeline = aggregator("blend"), two_plans()
    times_ns = range(100 * MS, 305 * MS, 4 * MS)
    followed = [goal(how, timeline, t) for t in times_ns]
    heights = np.array([height(one) for one in followed])
    assert heights[0] == pytest.approx(0.3, abs=ATOL_M)
    assert height(goal(how, timeline, 200 * MS)) == pytest.approx(0.32, abs=ATOL_M)
    assert goal(how, timeline, 300 * MS) is timeline.plan.goals[2]
    assert np.diff(heights).min() >= 0.0
    # No step at either end: the weight starts and ends with zero slope and curvature.
    assert np.diff(heights)[[0, -1]].max() < 1e-5
    assert {one.width_m for one in followed} == {0.06}
    for one in followed:
        share = (height(one) - 0.3) / 0.04
        exact = interpolate(at(0.3).pose, at(0.34, 0.4).pose, share).rotation
        assert angle_between(one.pose.rotation, exact) < ATOL_RAD


def test_a_blend_is_over_when_the_plan_before_it_ends() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(plan(0, [at(0.3)] * 2), 0)
    timeline.add(plan(100, [at(0.34)] * 8), 100 * MS)
    how = aggregator("blend")
    assert height(goal(how, timeline, 150 * MS)) == pytest.approx(0.32, abs=ATOL_M)
    assert goal(how, timeline, 200 * MS) is timeline.plan.goals[1]


@pytest.mark.parametrize("decay", [0.0, 0.01, 1.0])
def test_an_ensemble_weighs_every_plan_alive_by_its_age(decay: float) -> None:
    how, timeline = aggregator("ensemble", ensemble_decay=decay), two_plans()
    young = math.exp(-decay) / (1 + math.exp(-decay))
    followed = goal(how, timeline, 500 * MS)
    assert height(followed) == pytest.approx(0.3 + 0.04 * young, abs=ATOL_M)
    turned = at(0.3, 0.4 * young).pose.rotation
    assert angle_between(followed.pose.rotation, turned) < ATOL_RAD
    assert followed.width_m == 0.06
    # The older one ends; the newest stands alone, also after its own end.
    assert goal(how, timeline, 1000 * MS) is timeline.plan.goals[9]
    assert goal(how, timeline, 9000 * MS) is timeline.plan.goals[9]


def test_an_ensemble_is_reckoned_anew_only_when_a_waypoint_changes() -> None:
    how, timeline = aggregator("ensemble"), GoalTimeline(at(0.3), 0)
    timeline.add(plan(0, rising(at(0.3), 8)), 0)
    timeline.add(plan(50, rising(at(0.3), 8)), 50 * MS)
    first = goal(how, timeline, 60 * MS)
    assert goal(how, timeline, 99 * MS) is first
    assert goal(how, timeline, 100 * MS) is not first


def test_no_more_plans_than_declared_have_a_say() -> None:
    how, timeline = aggregator("ensemble", ensemble_plans=3), GoalTimeline(at(0.3), 0)
    for k in range(6):
        timeline.add(plan(k, [at(0.3 + k * STEP_M)] * 50), k * MS)
    assert len(how.plans(timeline, 10 * MS)) == 3


@pytest.mark.parametrize("mode", ["blend", "ensemble"])
def test_plans_of_another_episode_or_from_before_a_hold_have_no_say(mode: str) -> None:
    how, timeline = aggregator(mode), two_plans()
    timeline.add(plan(150, [at(0.5)] * 10, episode=2), 150 * MS)
    assert goal(how, timeline, 151 * MS) is timeline.plan.goals[0]
    timeline.hold(at(0.31), 160 * MS)
    assert height(goal(how, timeline, 160 * MS)) == 0.31
    timeline.add(plan(170, [at(0.6)] * 10, episode=2), 170 * MS)
    assert goal(how, timeline, 171 * MS) is timeline.plan.goals[0]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-0.7, 0.7)] * 3), min_size=1, max_size=8),
    st.floats(0.0, 2.0),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
)
def test_a_mean_of_rotations_is_the_same_in_any_frame(
    vectors: list[tuple[float, float, float]], decay: float, frame: tuple[float, float, float]
) -> None:
    weights = np.exp(-decay * np.arange(len(vectors)))
    poses = [Pose(np.array(v), exp3(np.array(v))) for v in vectors]
    turn = exp3(np.array(frame))
    mean = mean_pose(poses, weights)
    again = mean_pose([Pose(p.position_m, turn @ p.rotation) for p in poses], weights)
    assert angle_between(again.rotation, turn @ mean.rotation) < ATOL_RAD
    shares = weights / weights.sum()
    np.testing.assert_allclose(mean.position_m, shares @ np.array(vectors), atol=ATOL_M)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), REQUESTS)
def test_steps_are_counted_as_the_way_is(horizon: int, requests: list[tuple[int, int]]) -> None:
    timeline, now_ns = GoalTimeline(at(0.0), 0), 0
    for wait_ms, latency_ms in requests:
        observed_ns = now_ns + wait_ms * MS
        made = plan(observed_ns // MS, rising(timeline.at(observed_ns), horizon))
        before = timeline.in_force(observed_ns)
        made.steps_before = before.steps_until(observed_ns) if before.cause else 0.0
        now_ns = observed_ns + latency_ms * MS
        made.effective_ns = now_ns
        timeline.add(made, now_ns)
        for t_ns in (now_ns, now_ns + 70 * MS, now_ns + 999 * MS):
            asked = timeline.plan.steps_until(t_ns)
            assert height(timeline.plan.goal_at(t_ns)) == pytest.approx(asked * STEP_M)
            assert asked - ATOL_M <= timeline.plan.steps_in_force(t_ns) <= asked + 1 + ATOL_M
    end_ns = timeline.plan.end_ns
    assert timeline.plan.steps_in_force(end_ns) == timeline.plan.steps_until(end_ns)
