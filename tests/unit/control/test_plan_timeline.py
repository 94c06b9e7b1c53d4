"""Chunks as plans on a time axis: what was in force when, what replaces what."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from panda_arm import HOME_RAD, panda

from vla_zenoh.control.limits import into_workspace
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan, joint_goal
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3
from vla_zenoh.policy.plan_clock import HISTORY_NS
from vla_zenoh.profile import Limits

MS = 1_000_000
DT_NS = 100 * MS
STEP_M = 0.01
ATOL_M, ATOL_RAD = 1e-9, 1e-7


def at(height_m: float, width_m: float = 0.08, yaw_rad: float = 0.0) -> Goal:
    pose = Pose(np.array([0.4, 0.0, height_m]), exp3(np.array([0.0, 0.0, yaw_rad])))
    return Goal(pose, width_m)


def rising(before: Goal, steps: int) -> list[Goal]:
    z = float(before.pose.position_m[2])
    return [at(z + (k + 1) * STEP_M) for k in range(steps)]


def height(goal: Goal) -> float:
    return float(goal.pose.position_m[2])


def test_before_any_chunk_the_goal_is_to_stand() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    assert height(timeline.at(0)) == height(timeline.at(10**12)) == 0.3


@pytest.mark.parametrize(
    ("t_ms", "index"), [(-50, 0), (0, 0), (99, 0), (100, 1), (250, 2), (299, 2), (300, 2), (9e5, 2)]
)
def test_a_step_is_in_force_for_its_window(t_ms: float, index: int) -> None:
    plan = Plan(0, 0, DT_NS, rising(at(0.3), 3))
    assert plan.index_at(int(t_ms * MS)) == index


@pytest.mark.parametrize(
    ("t_ms", "steps"),
    [(-50, 1.0), (0, 1.0), (50, 1.0), (100, 1.0), (150, 1.5), (200, 2.0), (275, 2.75)]
    + [(300, 3.0), (400, 3.0)],
)
def test_a_plan_has_asked_for_the_time_it_had_and_for_one_step_at_least(
    t_ms: float, steps: float
) -> None:
    plan = Plan(0, 0, DT_NS, rising(at(0.3), 3))
    assert height(plan.goal_at(int(t_ms * MS))) == pytest.approx(0.3 + steps * STEP_M)


@pytest.mark.parametrize(
    ("t_ms", "steps"), [(-50, 0.0), (0, 0.0), (30, 0.3), (100, 1.0), (150, 1.5), (400, 3.0)]
)
def test_a_plan_that_has_a_begin_has_asked_for_the_time_it_had(t_ms: float, steps: float) -> None:
    plan = Plan(0, 0, DT_NS, rising(at(0.3), 3), begin=at(0.3))
    assert height(plan.goal_at(int(t_ms * MS))) == pytest.approx(0.3 + steps * STEP_M)
    assert plan.steps_until(int(t_ms * MS)) == pytest.approx(steps)


def test_between_two_waypoints_of_joints_the_width_goes_along() -> None:
    wide, narrow = (joint_goal(panda(), HOME_RAD, width_m) for width_m in (0.08, 0.04))
    assert wide.between(narrow, 0.25).width_m == pytest.approx(0.07)


def test_between_two_waypoints_rotation_and_width_go_along() -> None:
    plan = Plan(0, 0, DT_NS, [at(0.3, 0.08, 0.0), at(0.3, 0.04, 0.2)])
    goal = plan.goal_at(125 * MS)
    assert goal.width_m == pytest.approx(0.07)
    assert angle_between(goal.pose.rotation, at(0.3, yaw_rad=0.05).pose.rotation) < ATOL_RAD


@given(
    st.integers(1, 12),
    st.lists(st.tuples(st.integers(100, 500), st.integers(0, 99)), min_size=1, max_size=20),
)
def test_a_model_gets_the_speed_it_asks_for_however_often_it_is_asked(
    horizon: int, requests: list[tuple[int, int]]
) -> None:
    # Requests at least one step apart, each chunk published before the next observation is taken.
    timeline = GoalTimeline(at(0.0), 0)
    observed_ns, asked = 0, 0.0
    for period_ms, latency_ms in requests:
        base = timeline.at(observed_ns)
        plan = Plan(observed_ns + latency_ms * MS, observed_ns, DT_NS, rising(base, horizon))
        timeline.add(plan, observed_ns + latency_ms * MS)
        observed_ns += period_ms * MS
        asked += min(period_ms / 100, horizon)
    assert height(timeline.at(observed_ns)) == pytest.approx(asked * STEP_M, abs=ATOL_M)


@given(st.lists(st.tuples(st.integers(1, 300), st.integers(0, 300)), min_size=1, max_size=30))
def test_single_steps_are_all_counted_once_at_any_rate_and_latency(
    requests: list[tuple[int, int]],
) -> None:
    timeline, now_ns = GoalTimeline(at(0.0), 0), 0
    for wait_ms, latency_ms in requests:
        now_ns += wait_ms * MS  # after the last publication
        base = timeline.at(now_ns)
        published_ns = now_ns + latency_ms * MS
        timeline.add(Plan(published_ns, now_ns, DT_NS, rising(base, 1)), published_ns)
        now_ns = published_ns
    assert height(timeline.at(now_ns)) == pytest.approx(len(requests) * STEP_M, abs=ATOL_M)


def test_an_observation_from_before_the_last_chunk_replaces_it() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(Plan(80 * MS, 0, DT_NS, rising(at(0.3), 1)), 80 * MS)
    base = timeline.at(79 * MS)
    assert height(base) == pytest.approx(0.3)
    timeline.add(Plan(120 * MS, 79 * MS, DT_NS, rising(base, 1)), 120 * MS)
    assert height(timeline.at(200 * MS)) == pytest.approx(0.31)


def test_a_chunk_is_in_force_from_its_publication_not_from_its_arrival() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(Plan(50 * MS, 0, DT_NS, rising(at(0.3), 1)), 90 * MS)
    assert height(timeline.at(49 * MS)) == pytest.approx(0.3)
    assert height(timeline.at(50 * MS)) == pytest.approx(0.31)


@pytest.mark.parametrize("published_ms", [-10_000, 0, 10_000])
def test_a_lying_publication_time_is_kept_between_the_last_chunk_and_now(published_ms: int) -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(Plan(50 * MS, 0, DT_NS, rising(at(0.3), 1)), 50 * MS)
    plan = Plan(published_ms * MS, 60 * MS, DT_NS, rising(at(0.31), 1))
    timeline.add(plan, 100 * MS)
    assert 50 * MS <= plan.effective_ns <= 100 * MS
    assert height(timeline.at(100 * MS)) == pytest.approx(0.32)
    assert height(timeline.at(49 * MS)) == pytest.approx(0.3)


def test_a_hold_ends_a_plan() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(Plan(0, 0, DT_NS, rising(at(0.3), 8)), 0)
    timeline.hold(at(0.33), 300 * MS)
    assert height(timeline.at(299 * MS)) == pytest.approx(0.3299)
    assert height(timeline.at(800 * MS)) == pytest.approx(0.33)
    timeline.restart(at(0.5), 900 * MS)
    assert height(timeline.at(0)) == pytest.approx(0.5)


def test_what_was_in_force_is_known_for_as_long_as_an_observation_may_be_old() -> None:
    timeline = GoalTimeline(at(0.0), 0)
    for k in range(1, 3000):
        timeline.add(Plan(k * 10 * MS, k * 10 * MS, DT_NS, [at(k * 1e-4)]), k * 10 * MS)
    assert len(timeline._plans) < HISTORY_NS / (10 * MS) + 3
    newest_ns = 2999 * 10 * MS
    assert height(timeline.at(newest_ns - HISTORY_NS)) == pytest.approx(0.1499, abs=2e-4)


def test_a_shortened_goal_takes_the_later_ones_along() -> None:
    timeline = GoalTimeline(at(0.3), 0)
    timeline.add(Plan(0, 0, DT_NS, rising(at(0.3), 4)), 0)
    turned = at(0.315, yaw_rad=0.3)
    timeline.plan.shift_rest(1, turned, Limits())
    assert [round(height(goal), 6) for goal in timeline.plan.goals] == [0.31, 0.315, 0.325, 0.335]
    assert angle_between(timeline.plan.goals[3].pose.rotation, turned.pose.rotation) < ATOL_RAD


@given(st.lists(st.tuples(*[st.floats(-0.05, 0.05)] * 3), min_size=2, max_size=60), st.data())
def test_goals_that_a_leash_takes_along_stay_in_the_workspace(
    ways: list[tuple[float, float, float]], data: st.DataObject
) -> None:
    limits = Limits()
    position_m, goals = np.array([0.7, 0.4, 0.3]), []
    for way in ways:
        position_m, _ = into_workspace(limits, position_m + way)
        goals.append(Goal(Pose(position_m, np.eye(3)), 0.08))
    timeline = GoalTimeline(goals[0], 0)
    timeline.add(Plan(0, 0, DT_NS, goals), 0)
    index = data.draw(st.integers(0, len(ways) - 1))
    cut = Goal(Pose(goals[index].pose.position_m - [0.2, 0.2, 0.2], np.eye(3)), 0.08)
    timeline.plan.shift_rest(index, cut, limits)
    for goal in timeline.plan.goals[index + 1 :]:
        assert into_workspace(limits, goal.pose.position_m)[1] == 0.0
