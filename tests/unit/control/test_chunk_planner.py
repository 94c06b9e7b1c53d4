"""Chunks made plans in pieces: the same plan whatever the pieces, never more than the budget."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from command_rig import (
    DOWN,
    OFTEN,
    START_M,
    START_NS,
    Rig,
    lone_chunk,
    model_spec,
    profile,
    quat_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from panda_arm import panda, tool_down_at

from vla_zenoh.control.chunk_planner import PATIENCE, ChunkPlan, ChunkPlanner
from vla_zenoh.control.limits import Slowdown, keep_slowdown
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.kinematics import Approach
from vla_zenoh.kinematics.so3 import Pose, angle_between, norm3, rotation_from_quat
from vla_zenoh.profile import Limits, Profile, ReachLimits
from vla_zenoh.types import FloatArray

EXACT = 1e-12
AT_GOAL_M = 1e-6
UP = [0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0]
DOWNWARDS = [0.0, 0.0, -0.02, 0.0, 0.0, 0.0, 0.0]
TABLE_Z_M = 0.15
KINEMATICS = panda()
START_RAD = tool_down_at(KINEMATICS, *START_M)
START = Pose(START_M, rotation_from_quat(DOWN))
FAST_STEPS = {"dt_s": 1 / 30, "horizon": 64}


class CountingShadow(ReachabilityFilter):
    """A shadow that counts how often it looks for joints."""

    count = 0

    def _approach(self, pose: Pose, start_rad: FloatArray) -> Approach:
        self.count += 1
        return super()._approach(pose, start_rad)


def shadow(**limits: Any) -> CountingShadow:
    reach = ReachLimits(table_z_m=TABLE_Z_M)
    own = profile().model_copy(update={"limits": Limits(reach=reach, **limits)})
    counting = CountingShadow(own, KINEMATICS)
    counting.reset(START_RAD)
    return counting


# Both are asked the same questions in the same order, so that what their distances begin from is
# the same, too.
IN_PIECES, AT_ONCE = shadow(), shadow()


def arm_rig(of: Profile | None = None, reach: ReachabilityFilter = IN_PIECES, **action: Any) -> Rig:
    """An arm that stands over a table, with its kinematics."""
    reach.reset(START_RAD)
    rig = Rig(of, reach=reach, **{**FAST_STEPS, **action})
    start = KINEMATICS.forward(START_RAD)
    rig.position_m = start.position_m
    if action.get("kind") == "absolute":
        rig.tick(chunks=[rig.chunk([[*rig.position_m, *DOWN]])])
        rig.put("active", True)
        assert rig.state == "active", rig.commander.why
    else:
        rig.activate()
    return rig


def whole_plan(
    of: Profile, reach: ReachabilityFilter, budget: int, steps: Any, **action: Any
) -> ChunkPlan:
    """The plan of a chunk with every step of it bounded, `budget` evaluations a tick."""
    reach.reset(START_RAD)
    planner = ChunkPlanner(of, reach)
    planner.budget = budget
    timeline = GoalTimeline(Goal(START, 0.08), START_NS)
    spec = model_spec(**{**FAST_STEPS, **action}).action
    plan = planner.plan(lone_chunk(steps), spec, timeline)
    assert isinstance(plan, ChunkPlan), plan
    ready: Any = False
    while not ready:
        planner.begin_tick()
        ready = planner.bound(plan, START_NS)
    assert ready is True
    while plan.bounded < len(plan.goals):
        planner.begin_tick()
        planner.bound_due([plan], plan.end_ns)
    return plan


ways = st.tuples(*[st.floats(-0.04, 0.04)] * 3, *[st.floats(-0.15, 0.15)] * 3, st.just(0.0))


@settings(max_examples=20)
@given(
    st.lists(ways, min_size=1, max_size=12),
    st.sampled_from(["base", "tcp"]),
    st.integers(1, 13),
    st.sampled_from([0.0, -0.03]),
)
def test_a_plan_is_the_same_whatever_the_pieces_it_is_made_in(
    steps: list[tuple[float, ...]], frame: str, budget: int, sinking: float
) -> None:
    down = np.array(steps) + [0, 0, sinking if frame == "base" else -sinking, 0, 0, 0, 0]
    pieces = whole_plan(profile(), IN_PIECES, budget, down, frame=frame)
    once = whole_plan(profile(), AT_ONCE, 10**9, down, frame=frame)
    assert pieces.hits == once.hits
    for ours, theirs in zip(pieces.goals, once.goals, strict=True):
        np.testing.assert_allclose(ours.pose.position_m, theirs.pose.position_m, atol=EXACT, rtol=0)
        np.testing.assert_allclose(ours.pose.rotation, theirs.pose.rotation, atol=EXACT, rtol=0)
        assert (ours.width_m, ours.slowdown) == (theirs.width_m, theirs.slowdown)


def test_absolute_targets_behind_a_limit_do_not_wander_with_what_it_cut() -> None:
    away_m = 0.02 * np.arange(1, 13)
    down = [[*(START_M - [0.0, 0.0, z]), np.pi, 0.0, 0.0, 0.0] for z in away_m]
    back = [[*START_M, np.pi, 0.0, 0.0, 0.0]] * 6
    plan = whole_plan(profile(), IN_PIECES, 6, [*down, *down[::-1], *back], kind="absolute")
    assert "table_distance" in {hit.name for hit in plan.hits}
    np.testing.assert_allclose(plan.goals[-1].pose.position_m, START_M, atol=1e-7)


# -- the budget -----------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", ["replace", "blend", "ensemble"])
def test_no_tick_evaluates_the_arm_more_often_than_its_budget_allows(mode: str) -> None:
    rig = arm_rig(profile(composition={"mode": mode}, timing=OFTEN))
    budget = rig.commander._planner.budget
    assert budget <= 10
    most = total = 0
    for tick in range(1, 200):
        IN_PIECES.count = 0
        chunks = [rig.chunk([DOWNWARDS] * 16, observed_ago_s=0.08)] if tick % 25 == 0 else []
        rig.tick(chunks=chunks)
        most, total = max(most, IN_PIECES.count), total + IN_PIECES.count
    assert most == budget
    assert total > 10 * budget
    assert any(event.what == "table_distance" for event in rig.events)
    rig.assert_smooth()


@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_in_free_space_a_chunk_is_in_force_in_the_tick_in_which_it_came(late_s: float) -> None:
    rig = arm_rig()
    rig.run(0.2)
    for _ in range(5):
        out = rig.send([UP] * 16, observed_ago_s=late_s)
        assert out.accepted is not None
        assert out.pose is not None
        assert out.pose.cause == out.accepted
        rig.run(0.1)


def test_until_a_chunk_is_bounded_the_one_before_it_stays_in_force() -> None:
    rig = arm_rig(profile(timing=OFTEN))
    rig.run(0.3)
    first = rig.send([UP] * 16).accepted
    assert first is not None
    rig.run(0.3)
    out = rig.send([UP] * 24, observed_ago_s=0.3)
    waited = 0
    while out.accepted is None:
        assert out.pose is not None
        assert out.pose.cause == first
        out, waited = rig.tick(), waited + 1
    assert 0 < waited <= math.ceil(PATIENCE / rig.commander._planner.budget)
    rig.settle(2.0)
    # Of the first what it had time for, 12 ms, until the second was observed; all of the second.
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 0.01 * 24.12], atol=AT_GOAL_M)
    rig.assert_smooth()


def test_a_chunk_that_is_hard_to_bound_is_in_force_after_some_ticks_as_far_as_it_is() -> None:
    rig = arm_rig(profile(timing=OFTEN))
    rig.run(0.3)
    rig.send([UP] * 16)
    rig.run(0.4)
    out, waited = rig.send([DOWNWARDS] * 24, observed_ago_s=0.4), 0
    while out.accepted is None:
        out, waited = rig.tick(), waited + 1
    assert waited == math.ceil(PATIENCE / rig.commander._planner.budget) - 1
    plan = rig.commander.parts[0].motion.timeline
    assert plan is not None
    assert plan.plan.bounded < plan.plan.due_index(rig.now_ns) + 1


def test_chunks_that_come_while_another_is_bounded_lose_no_step() -> None:
    rig = arm_rig(profile(timing=OFTEN), dt_s=0.02)
    rig.run(0.4)
    asked, up = 0.0, [0.0, 0.0, 0.004, 0.0, 0.0, 0.0, 0.0]
    for _ in range(2):
        rig.send([up] * 12)
        rig.run(0.2)
        # Ten steps are due when it arrives; the next one comes before it is in force.
        rig.tick(chunks=[rig.chunk([up] * 12, observed_ago_s=0.2, published_ago_s=0.02)])
        rig.tick(chunks=[rig.chunk([up], observed_ago_s=0.01)])
        rig.run(0.3)
        # One tick of the first, of the second until the third was observed, and the third.
        asked += 0.004 / 0.02 + (0.2 + 0.004 - 0.01) / 0.02 + 1
    assert rig.refused == {}
    rig.settle(2.0)
    np.testing.assert_allclose(rig.moved_m(), [0, 0, 0.004 * asked], atol=AT_GOAL_M)


def test_of_a_heap_only_the_newest_is_carried_out_and_the_others_are_counted_quietly() -> None:
    rig = arm_rig()
    rig.run(0.3)
    rig.events.clear()
    IN_PIECES.count = 0
    heap = [rig.chunk([UP], observed_ago_s=0.002 * k) for k in reversed(range(64))]
    out = rig.tick(chunks=heap)
    assert out.accepted is not None
    assert out.accepted.chunk_seq == heap[-1].header.seq
    assert rig.refused == {"overtaken": 63}
    assert all(refusal.quiet for refusal in out.rejections)
    assert rig.events == []
    assert rig.commander._planner.budget >= IN_PIECES.count
    rig.settle()
    np.testing.assert_allclose(rig.moved_m(), UP[:3], atol=AT_GOAL_M)


def test_of_a_heap_whose_newest_is_a_mistake_the_one_before_is_carried_out() -> None:
    rig = arm_rig()
    rig.run(0.3)
    wrong = [10.0, 0, 0, 0, 0, 0, 0]
    heap = [rig.chunk([UP], observed_ago_s=0.1), rig.chunk([UP], observed_ago_s=0.05)]
    out = rig.tick(chunks=[*heap, rig.chunk([UP, wrong])])
    assert out.accepted is not None
    assert out.accepted.chunk_seq == heap[1].header.seq
    assert rig.refused == {"overtaken": 1, "step_m": 1}


@pytest.mark.parametrize("order", ["stop", "prompt"])
def test_a_chunk_that_is_not_in_force_yet_never_will_be_after_a_stop_or_another_prompt(
    order: str,
) -> None:
    # All of its steps are bounded first.
    rig = arm_rig(profile(limits={"out_of_bounds": "refuse"}))
    rig.run(0.4)
    assert rig.send([UP] * 24).accepted is None
    out = rig.tick("stop") if order == "stop" else rig.put("prompt", "something else")
    assert out.accepted is None
    assert rig.refused == {"superseded": 1}
    rig.run(0.5)
    np.testing.assert_allclose(rig.moved_m(), np.zeros(3), atol=AT_GOAL_M)


@pytest.mark.parametrize(("count", "refused"), [(8, {}), (20, {"table_distance": 1})])
def test_a_profile_that_refuses_what_is_out_of_bounds_decides_when_all_of_it_is_known(
    count: int, refused: dict[str, int]
) -> None:
    rig = arm_rig(profile(limits={"out_of_bounds": "refuse"}, timing=OFTEN))
    IN_PIECES.count = 0
    out = rig.send([[0, 0, -0.01, 0, 0, 0, 0]] * count)
    assert out.accepted is None
    assert rig.commander._planner.budget == IN_PIECES.count
    accepted = [rig.tick().accepted for _ in range(10)]
    assert any(accepted) == (not refused)
    assert rig.refused == refused
    rig.settle(2.0)
    moved_m = 0.0 if refused else -0.01 * count
    np.testing.assert_allclose(rig.moved_m(), [0, 0, moved_m], atol=AT_GOAL_M)


# -- what is told ---------------------------------------------------------------------------------
def test_every_limit_that_acted_on_a_chunk_is_told_once_the_first_on_its_way_first() -> None:
    rig = Rig()
    rig.activate()
    rig.events.clear()
    edge_m = rig.profile.limits.workspace.y_m[1]
    aside = [0.0, 0.04, 0.0, 0, 0, 0, 0]
    rig.send(
        [[0.08, 0, 0, 0, 0, 0, 0], *[aside] * (math.ceil(edge_m / 0.04) + 2), [0.08] + 6 * [0]]
    )
    rig.run(2.0)
    limits = [event.what for event in rig.events if event.kind == "limit"]
    assert limits[0] == "step_m"
    assert sorted(set(limits) - {"lead_m"}) == ["step_m", "workspace"]
    assert limits.count("step_m") == limits.count("workspace") == 1


# -- absolute targets that are far ----------------------------------------------------------------
def absolute_rig(of: Profile | None = None, **action: Any) -> Rig:
    rig = Rig(of, kind="absolute", rotation="quaternion", gripper="none", **action)
    rig.tick(chunks=[rig.chunk([[*START_M, *DOWN]])])
    rig.put("active", True)
    assert rig.state == "active"
    return rig


def go(rig: Rig, target: Any, duration_s: float, period_s: float = 0.1) -> None:
    for _ in range(round(duration_s / period_s)):
        rig.send([target])
        rig.run(period_s - 0.004)


def test_a_far_absolute_target_is_approached_straight_and_slowly() -> None:
    rig = absolute_rig()
    target_m = START_M + [0.15, 0.15, 0.1]
    away_m = norm3(target_m - START_M)
    go(rig, [*target_m, *DOWN], 3.0, 0.1)
    rig.settle()
    assert rig.refused == {}
    np.testing.assert_allclose(rig.position_m, target_m, atol=AT_GOAL_M)
    (event,) = [event for event in rig.events if event.what == "approach"]
    assert (event.level, event.value) == ("info", pytest.approx(away_m))
    assert event.limit == rig.profile.limits.step_m
    assert f"{away_m:.3g} m away" in event.why
    direction = (target_m - START_M) / away_m
    fastest = rig.profile.limits.approach_m_s
    for command in rig.commands:
        gone = command.position_m - START_M
        for on_line, apart_m in ((gone, 2e-3), (command.goal_position_m - START_M, 1e-7)):
            assert norm3(on_line - (on_line @ direction) * direction) < apart_m
        # The arm is some centimetres behind its goal, which may go faster within the last step.
        if away_m - gone @ direction > rig.profile.limits.step_m + 0.05:
            assert norm3(command.twist[:3]) <= fastest * (1 + 1e-6)
    rig.assert_smooth()


def test_an_approach_is_no_faster_the_more_often_a_model_is_asked() -> None:
    rig = absolute_rig()
    go(rig, [*(START_M + [0.25, 0.0, 0.0]), *DOWN], 1.2, 0.02)
    assert rig.moved_m()[0] < 0.2
    fastest = max(norm3(command.twist[:3]) for command in rig.commands)
    assert fastest <= rig.profile.limits.approach_m_s * (1 + 1e-6)


def test_a_far_turn_is_approached_likewise() -> None:
    rig = absolute_rig()
    go(rig, [*START_M, *quat_of([0.0, 0.0, 1.5])], 3.0)
    rig.settle()
    np.testing.assert_allclose(rig.turned_rad(), [0, 0, 1.5], atol=1e-6)
    (event,) = [event for event in rig.events if event.what == "approach"]
    assert "1.5 rad away" in event.why
    turning = [
        norm3(command.twist[3:])
        for command in rig.commands
        if angle_between(rotation_from_quat(command.quat_xyzw), rotation_from_quat(DOWN)) < 1.1
    ]
    assert max(turning) <= rig.profile.limits.approach_rad_s * (1 + 1e-6)


@pytest.mark.parametrize(("far_m", "far_rad", "unit"), [(0.2, 0.3, "m"), (0.1, 0.7, "rad")])
def test_a_far_target_is_told_in_the_unit_of_which_it_takes_more_steps(
    far_m: float, far_rad: float, unit: str
) -> None:
    """Of 0.05 m and 0.2 rad at most: the first takes 4 steps and 1.5, the second 2 and 3.5."""
    rig = absolute_rig(profile(limits={"step_m": 0.05, "step_rad": 0.2}))
    go(rig, [*(START_M + [far_m, 0.0, 0.0]), *quat_of([0.0, 0.0, far_rad])], 0.5)
    (event,) = [event for event in rig.events if event.what == "approach"]
    assert f" {unit} away" in event.why
    assert event.value == pytest.approx(far_m if unit == "m" else far_rad)


def test_an_approach_that_a_profile_declares_faster_is_faster() -> None:
    rig = absolute_rig(profile(limits={"approach_m_s": 0.3}))
    go(rig, [*(START_M + [0.3, 0.0, 0.0]), *DOWN], 1.5)
    assert max(norm3(command.twist[:3]) for command in rig.commands) > 0.2
    assert rig.position_m[0] - START_M[0] > 0.25


@pytest.mark.parametrize(
    ("target_m", "away"), [((450.0, 20.0, 320.0), "551"), ((0.45, 0.9, 0.3), "0.45")]
)
def test_a_target_far_outside_the_workspace_is_refused_with_how_far_and_what_to_do(
    target_m: tuple[float, ...], away: str
) -> None:
    rig = absolute_rig()
    out = rig.send([[*target_m, *DOWN]])
    assert out.accepted is None
    assert rig.refused == {"workspace": 1}
    (event,) = [event for event in rig.events if event.kind == "refusal"]
    assert event.why.startswith("scripted: a target at"), "of an arm without parts"
    assert f"{away}" in event.why
    assert "m outside the workspace" in event.why
    assert "position_scale_m" in event.why
    rig.run(0.5)
    np.testing.assert_allclose(rig.moved_m(), np.zeros(3), atol=AT_GOAL_M)


def test_a_target_a_little_outside_the_workspace_is_led_to_its_border() -> None:
    rig = absolute_rig()
    edge_m = rig.profile.limits.workspace.x_m[1]
    go(rig, [edge_m + 0.1, 0.0, 0.3, *DOWN], 5.0)
    rig.settle()
    np.testing.assert_allclose(rig.position_m, [edge_m, 0.0, 0.3], atol=AT_GOAL_M)


# -- joints that are too slow ---------------------------------------------------------------------
def test_a_target_for_which_the_joints_are_too_slow_is_reached_slower() -> None:
    slow = shadow(step_m=0.15)
    slow._velocity_rad_s = np.full(KINEMATICS.size, 0.3)
    rig = arm_rig(
        profile(limits={"step_m": 0.15}),
        slow,
        kind="absolute",
        rotation="quaternion",
        gripper="none",
        dt_s=0.1,
    )
    target_m = rig.position_m + [0.0, 0.14, 0.0]
    go(rig, [*target_m, *DOWN], 2.0)
    rig.settle()
    np.testing.assert_allclose(rig.position_m, target_m, atol=AT_GOAL_M)
    told = [event for event in rig.events if event.what == "joint_velocity"]
    assert [event.level for event in told] == ["info"]
    # Joints of the poses that were commanded, as far apart as the ticks are.
    joints = [START_RAD]
    for command in rig.commands:
        pose = Pose(command.position_m, rotation_from_quat(command.quat_xyzw))
        joints.append(slow._solver.approach(pose, joints[-1], bounded=False).joints_rad)
    speed = np.abs(np.diff(joints, axis=0)).max() * rig.profile.timing.command_hz
    assert speed < 0.3 * 1.25  # of a straight step whose middle needs more than its mean
    # Told again when it is activated again, though not at every step.
    rig.put("active", False)
    rig.settle()
    rig.send([[*rig.position_m, *DOWN]])
    rig.put("active", True)
    rig.events.clear()
    go(rig, [*(target_m - [0.0, 0.14, 0.0]), *DOWN], 5.0)
    assert [event.what for event in rig.events].count("joint_velocity") == 1


def test_what_slowed_a_step_lasts_until_the_arm_is_through_with_it() -> None:
    slow = Slowdown("joint_velocity", 0.5, 3.0, 2.0, "joint1", late_s=0.15)
    then = keep_slowdown(slow, None, 0.1, 0.3)
    assert then is not None
    assert (then.name, then.share, then.late_s) == ("joint_velocity", 0.5, pytest.approx(0.05))
    assert keep_slowdown(then, None, 0.1, 0.3) is None
    near = Slowdown("table_distance", 0.5, 0.1, 0.2, "hand")  # the arm is not late
    assert keep_slowdown(near, None, 0.1, 0.3) is None
    faster = slow._replace(share=0.8)
    assert keep_slowdown(near, faster, 0.1, 0.3) is faster
    twice = keep_slowdown(slow, slow._replace(share=0.8), 0.1, 0.3)
    assert twice is not None
    assert (twice.share, twice.late_s) == (0.5, pytest.approx(0.3))
    # Never longer than the way takes by which the leash lets the goal be ahead.
    long = keep_slowdown(slow._replace(late_s=9.0), slow, 0.1, 0.3)
    assert long is not None
    assert long.late_s == pytest.approx(0.6)


def test_later_steps_are_bounded_before_they_are_due_though_every_tick_plans_a_motion() -> None:
    rig = arm_rig(profile(timing=OFTEN), dt_s=0.004)
    rig.tick(chunks=[rig.chunk([[0.0005, 0, 0, 0, 0, 0, 0]] * 30)])
    ahead: list[int] = []
    for _ in range(12):
        rig.tick()
        motion = rig.commander.parts[0].motion
        assert motion.timeline is not None
        plan = motion.timeline.plan
        assert isinstance(plan, ChunkPlan)
        ahead.append(plan.bounded - 1 - plan.due_index(rig.now_ns))
    assert min(ahead[4:]) >= 3, ahead
