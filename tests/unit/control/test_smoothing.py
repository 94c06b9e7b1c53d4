"""The smoothed motion: within its limits, an integral of its own twist, exactly at its target."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vla_zenoh.control.limits import (
    PAUSE_LEAD_M,
    PAUSE_LEAD_RAD,
    MotionLimits,
    Shares,
    workspace_corners,
)
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.smoothing import Motion, PosePath, Smoother
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3, log3, norm3
from vla_zenoh.profile import load_profile

DT_S = 0.004
LIMITS = MotionLimits((0.5, 2.0, 20.0), (1.5, 6.0, 60.0))
START = Pose(np.array([0.43, 0.0, 0.3]), exp3(np.array([3.0, 0.2, -0.4])))

LIMIT_RTOL = 1e-6
STILL = 1e-6  # m/s and rad/s
LEAST_SHARE = 1e-3
AT_TARGET_M, AT_TARGET_RAD = 1e-8, 1e-7
# Errors of the trapezium rule over one tick of a motion whose jerk is bounded.
STEP_ATOL_M, STEP_ATOL_RAD = 2e-7, 1e-6
BACKWARDS_M_S = 1e-9
SPEED_ATOL = np.array([2e-4] * 3 + [1e-3] * 3)
SLOWEST, REACH_M = 0.1, 0.15
OUTSIDE_M = 1e-5

offsets = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)
targets = st.tuples(offsets, offsets).map(lambda pair: (REACH_M * pair[0], 0.6 * pair[1]))
shares = st.builds(Shares, *[st.floats(0.1, 1.0)] * 3)
orders = st.lists(
    st.tuples(st.integers(1, 90), st.none() | shares | targets), min_size=1, max_size=12
)


def smoother() -> Smoother:
    return Smoother(START, DT_S, LIMITS)


def ordered(motion: Smoother, order: tuple[np.ndarray, np.ndarray] | Shares | None) -> None:
    if order is None or isinstance(order, Shares):
        motion.brake_together(order)
        return
    here = motion.motion.pose
    parts = SLOWEST + (1 - SLOWEST) * np.abs(order[0]) / REACH_M
    goal = Pose(START.position_m + order[0], exp3(order[1]) @ here.rotation)
    motion.target(goal, Shares(*parts.tolist()))


def check_tick(before: Motion, now: Motion) -> None:
    jerk = (now.acceleration - before.acceleration) / DT_S
    for order, values in enumerate((now.twist, now.acceleration, jerk)):
        assert np.abs(values[:3]).max() <= LIMITS.translation[order] * (1 + LIMIT_RTOL)
        assert norm3(values[3:]) <= LIMITS.rotation[order] * (1 + LIMIT_RTOL)
    moved = now.pose.position_m - before.pose.position_m
    mean = (before.twist + now.twist) * (DT_S / 2)
    np.testing.assert_allclose(moved, mean[:3], atol=STEP_ATOL_M)
    turned = log3(now.pose.rotation @ before.pose.rotation.T)
    np.testing.assert_allclose(turned, mean[3:], atol=STEP_ATOL_RAD)
    quicker = (before.acceleration + now.acceleration) * (DT_S / 2)
    assert (np.abs(now.twist - before.twist - quicker) <= SPEED_ATOL).all()


@settings(max_examples=20)
@given(orders)
def test_limits_hold_and_the_pose_is_the_integral_of_the_twist_whatever_is_ordered_when(
    given_orders: list[tuple[int, tuple[np.ndarray, np.ndarray] | Shares | None]],
) -> None:
    motion = smoother()
    for ticks, order in given_orders:
        ordered(motion, order)
        for _ in range(ticks):
            before = motion.motion
            check_tick(before, motion.tick())
    assert motion.failures == 0


@settings(max_examples=20)
@example([(3, (np.array([0.0, 0.0, 0.15]), np.array([0.0, 0.0, 0.6])))], (np.zeros(3), np.zeros(3)))
@given(orders, targets)
def test_it_ends_exactly_on_its_last_target(
    given_orders: list[tuple[int, tuple[np.ndarray, np.ndarray] | Shares | None]],
    last: tuple[np.ndarray, np.ndarray],
) -> None:
    motion = smoother()
    for ticks, order in given_orders:
        ordered(motion, order)
        for _ in range(ticks):
            motion.tick()
    goal = Pose(START.position_m + last[0], exp3(last[1]) @ motion.motion.pose.rotation)
    motion.target(goal)
    for _ in range(round(4.0 / DT_S)):
        motion.tick()
    assert motion.at_rest
    assert norm3(motion.motion.pose.position_m - goal.position_m) < AT_TARGET_M
    assert angle_between(motion.motion.pose.rotation, goal.rotation) < AT_TARGET_RAD


@settings(max_examples=20)
@given(orders)
def test_a_brake_ends_where_it_was_foretold_and_stays_there(
    given_orders: list[tuple[int, tuple[np.ndarray, np.ndarray] | Shares | None]],
) -> None:
    motion = smoother()
    for ticks, order in given_orders:
        ordered(motion, order)
        for _ in range(ticks):
            motion.tick()
    foretold = motion.resting_pose()
    longest_s = max(
        limit[0] / limit[1] + 2 * limit[1] / limit[2] for limit in (LIMITS.translation, LIMITS[1])
    )
    for _ in range(round(20 * longest_s / DT_S)):
        if motion.at_rest:
            break
        before = motion.motion
        check_tick(before, motion.tick())
    assert motion.at_rest
    assert norm3(motion.motion.pose.position_m - foretold.position_m) < AT_TARGET_M
    assert angle_between(motion.motion.pose.rotation, foretold.rotation) < AT_TARGET_RAD


@pytest.mark.parametrize("jerk", [0.02, 0.1, 1.0])
def test_a_way_that_goes_on_with_little_jerk_gets_no_faster_than_it_may(jerk: float) -> None:
    motion = smoother()
    goal = Pose(START.position_m + [1.0, 0.0, 0.0], START.rotation)
    motion.target(goal)
    for _ in range(34):
        motion.tick()
    motion.target(goal, Shares(jerk=jerk))
    while not motion.at_rest:
        before = motion.motion
        check_tick(before, motion.tick())
    assert norm3(motion.motion.pose.position_m - goal.position_m) < AT_TARGET_M


@pytest.mark.parametrize("jerk", [0.02, 0.1, 1.0])
def test_a_brake_that_has_little_jerk_gets_no_faster_first(jerk: float) -> None:
    motion = smoother()
    motion.target(Pose(START.position_m + [0.15, 0.0, 0.0], exp3([-0.5, 0.0, -0.3])))
    for _ in range(34):
        motion.tick()
    assert motion.motion.acceleration[0] > 0
    motion.brake_together(Shares(jerk=jerk))
    foretold = motion.resting_pose()
    while not motion.at_rest:
        before = motion.motion
        check_tick(before, motion.tick())
        assert motion.motion.twist[0] >= -BACKWARDS_M_S
        again = motion.resting_pose()
        assert norm3(again.position_m - foretold.position_m) < AT_TARGET_M


def test_a_brake_stops_within_the_jerk_limit_and_never_turns_back() -> None:
    motion = smoother()
    motion.target(Pose(START.position_m + [0.3, 0.0, 0.0], START.rotation))
    for _ in range(100):
        motion.tick()
    assert motion.motion.twist[0] > 0.4
    motion.brake()
    while not motion.at_rest:
        before = motion.motion
        now = motion.tick()
        check_tick(before, now)
        assert now.twist[0] >= -STILL
    assert motion.motion.pose.position_m[0] < START.position_m[0] + 0.3


def test_half_a_turn_is_reached_in_small_targets_without_wrapping() -> None:
    motion = smoother()
    goal = START.rotation
    for _ in range(80):
        goal = exp3(np.array([0.0, 0.0, 0.05])) @ goal
        motion.target(Pose(START.position_m, goal))
        for _ in range(25):
            before = motion.motion
            check_tick(before, motion.tick())
    for _ in range(250):
        motion.tick()
    assert angle_between(motion.motion.pose.rotation, goal) < AT_TARGET_RAD
    assert angle_between(START.rotation, goal) == pytest.approx(2 * math.pi - 4.0)


def test_a_turn_that_gets_other_axes_over_and_over_has_no_step_in_its_speed() -> None:
    rng, motion = np.random.default_rng(0), smoother()
    for _ in range(8):
        ordered(motion, (REACH_M * rng.uniform(-1, 1, 3), 0.6 * rng.uniform(-1, 1, 3)))
        for _ in range(rng.integers(20, 60)):
            before = motion.motion
            check_tick(before, motion.tick())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_goal_before_or_behind_a_moving_tcp_is_on_the_leash_of_its_next_command(
    sign: float,
) -> None:
    profile = load_profile("panda_sim")
    path, side = PosePath(profile), np.eye(3)[1]
    path.reset(START)
    path.go_to(Goal(Pose(START.position_m + 0.1 * side, START.rotation), 0.0))
    for _ in range(60):
        path.tick()
    asked = Goal(Pose(START.position_m + 0.35 * sign * side, START.rotation), 0.0)
    goal, hits = path.leash(asked, 1 / profile.timing.command_hz)
    path.go_to(goal)
    lead_m = (goal.pose.position_m - path.tick().pose.position_m)[1]
    assert [hit.name for hit in hits] == ["lead_m"]
    assert lead_m == pytest.approx(sign * profile.limits.lead_m, abs=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e9])
def test_an_impossible_target_brakes_and_the_next_good_one_is_reached(bad: float) -> None:
    motion = smoother()
    good = Pose(START.position_m + [0.1, 0.0, 0.0], START.rotation)
    motion.target(good)
    for _ in range(50):
        motion.tick()
    assert motion.motion.twist[0] > 0.1
    motion.target(Pose(np.array([bad, 0.0, 0.3]), START.rotation))
    for _ in range(100):
        before = motion.motion
        check_tick(before, motion.tick())
    assert motion.failures == 1
    assert motion.braking
    motion.target(good)
    for _ in range(500):
        before = motion.motion
        check_tick(before, motion.tick())
    assert norm3(motion.motion.pose.position_m - good.position_m) < AT_TARGET_M


def test_a_motion_taken_over_goes_on_without_a_step_and_brakes() -> None:
    leader, follower = smoother(), smoother()
    leader.target(
        Pose(START.position_m + [0.1, -0.05, 0.1], exp3([0.3, 0.2, 0.1]) @ START.rotation)
    )
    for _ in range(60):
        leader.tick()
    follower.brake_from(leader.motion)
    leader.brake()
    for _ in range(150):
        before = follower.motion
        now = follower.tick()
        check_tick(before, now)
        np.testing.assert_allclose(now.pose.position_m, leader.tick().pose.position_m, atol=1e-12)
    assert follower.at_rest


def test_it_stands_still_until_it_is_told_to_move() -> None:
    motion = smoother()
    for _ in range(10):
        now = motion.tick()
    assert motion.at_rest
    np.testing.assert_array_equal(now.twist, np.zeros(6))
    np.testing.assert_array_equal(now.pose.position_m, START.position_m)


def test_who_is_given_less_speed_in_motion_slows_down_to_it_and_keeps_to_it() -> None:
    motion, share = smoother(), 0.2
    far = Pose(START.position_m + [0.3, 0.0, 0.0], START.rotation)
    motion.target(far)
    for _ in range(80):
        motion.tick()
    assert motion.motion.twist[0] > 2 * share * LIMITS.translation[0]
    motion.target(far, Shares(share))
    speeds: list[float] = []
    for _ in range(150):
        before = motion.motion
        check_tick(before, motion.tick())
        speeds.append(motion.motion.twist[0])
    slow = share * LIMITS.translation[0]
    assert speeds[-1] == pytest.approx(slow, abs=STILL)
    assert motion.failures == 0


def test_reset_forgets_all_motion() -> None:
    motion = smoother()
    motion.target(Pose(START.position_m + [0.1, 0.0, 0.0], START.rotation))
    for _ in range(30):
        motion.tick()
    there = Pose(np.array([0.5, 0.1, 0.2]), exp3(np.array([0.0, 1.0, 0.0])))
    motion.reset(there)
    now = motion.tick()
    assert motion.at_rest
    np.testing.assert_allclose(now.pose.position_m, there.position_m, atol=1e-15)
    np.testing.assert_allclose(now.pose.rotation, there.rotation, atol=1e-12)


# An axis that stands at its goal, and the range that a motion keeps.
AT_GOAL = np.array([1e-5] * 3 + [1e-5] * 3)  # m, rad
noises = st.floats(-1.0, 1.0).flatmap(
    lambda sign: st.sampled_from([1e-16, 1e-14, 1e-12, 1e-10]).map(lambda size: sign * size)
)


class Ends:
    """A rotation-free view of a motion: translation, and turns about one base axis."""

    def __init__(self, motion: Smoother) -> None:
        self.motion = motion

    def away(self) -> np.ndarray:
        pose = self.motion.motion.pose
        return np.concatenate(
            [pose.position_m - START.position_m, log3(pose.rotation @ START.rotation.T)]
        )


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.integers(3, 90), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), noises),
        min_size=3,
        max_size=8,
    )
)
def test_an_axis_at_its_goal_stays_there_whatever_the_others_do(
    retargets: list[tuple[int, float, float, float]],
) -> None:
    motion = smoother()
    turn = exp3(np.array([0.0, 0.0, 1.0]))
    for ticks, x_m, yaw_rad, noise in retargets:
        # Rounding in whoever computes the goals: z, roll and pitch are to stand.
        position_m = START.position_m + [x_m, 0.0, noise]
        rotation = exp3(np.array([noise, -noise, yaw_rad])) @ START.rotation
        motion.target(Pose(position_m, turn.T @ turn @ rotation))
        for _ in range(ticks):
            motion.tick()
            away = Ends(motion).away()
            assert (np.abs(away[[1, 2, 3, 4]]) < AT_GOAL[[1, 2, 3, 4]]).all()


def stop_range(motion: Motion, share: float, axes: np.ndarray) -> np.ndarray:
    """(2, 3) m: least and greatest positions of these axes' stop with a share of their limits."""
    (velocity, acceleration, jerk), rotation = LIMITS
    limits = MotionLimits((velocity, share * acceleration, share * jerk), rotation)
    stopping = Smoother(motion.pose, DT_S, limits)
    only = np.concatenate([axes, np.zeros(3)])
    stopping.brake_from(Motion(motion.pose, only * motion.twist, only * motion.acceleration))
    path = [stopping.motion.pose.position_m]
    while not stopping.at_rest:
        path.append(stopping.tick().pose.position_m)
    return np.array([np.min(path, axis=0), np.max(path, axis=0)])


def brake_ranges(motion: Motion, axes: Callable[[], np.ndarray]) -> Iterator[np.ndarray]:
    """(2, 3) m: least and greatest positions of the shortest stops from here.

    That is each axis by itself, or, to stay on a line, all axes in the proportion of the fastest:
    of a slow axis that may take minutes, so it is only found out for `axes` that need it.
    """
    yield stop_range(motion, 1.0, np.ones(3))
    speeds = np.abs(motion.twist[:3])
    for axis, share in enumerate(speeds / max(speeds.max(), STILL)):
        if LEAST_SHARE < share < 1.0 and axes()[axis]:
            yield stop_range(motion, float(share), np.eye(3)[axis])


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(1, 70), offsets), min_size=2, max_size=6))
def test_a_retargeted_motion_stays_between_its_start_its_target_and_where_it_can_stop(
    retargets: list[tuple[int, np.ndarray]],
) -> None:
    motion = smoother()
    for ticks, offset in retargets:
        target, begun = START.position_m + REACH_M * offset, motion.motion
        motion.target(Pose(target, START.rotation))
        path = np.array([motion.tick().pose.position_m for _ in range(ticks)])
        ends = [begun.pose.position_m, target]

        def beyond(path: np.ndarray = path, ends: list[np.ndarray] = ends) -> np.ndarray:
            low, high = np.min(ends, axis=0) - AT_GOAL[:3], np.max(ends, axis=0) + AT_GOAL[:3]
            return ~((path >= low) & (path <= high)).all(axis=0)

        for stops in brake_ranges(begun, beyond):
            ends += [*stops]
        assert not beyond().any()


@settings(max_examples=25)
@given(
    offsets,
    offsets,
    st.lists(st.tuples(st.integers(1, 60), st.floats(0.05, 1.0), shares), min_size=2, max_size=8),
)
def test_a_motion_along_a_line_stays_on_it_whatever_the_limits_become(
    along: np.ndarray, turn: np.ndarray, orders: list[tuple[int, float, Shares]]
) -> None:
    motion, way = smoother(), np.concatenate([REACH_M * along, 0.6 * turn])
    length = float(np.linalg.norm(way))
    for ticks, part, parts in orders:
        goal = Pose(START.position_m + part * way[:3], exp3(part * way[3:]) @ START.rotation)
        motion.target(goal, parts)
        for _ in range(ticks):
            motion.tick()
            away = Ends(motion).away()
            beside = away - (away @ way) / max(length, 1e-9) ** 2 * way
            assert np.abs(beside).max() < AT_GOAL[0]


def test_an_axis_at_one_percent_of_the_speed_brakes_however_often_its_goal_is_repeated() -> None:
    slow, often, once = Shares(1e-2, 1e-4, 1e-6), smoother(), smoother()
    for motion in (often, once):
        motion.target(Pose(START.position_m + [0.0, 2e-4, 1e-4], START.rotation), slow)
        for _ in range(700):
            motion.tick()
    goal = Pose(START.position_m + [0.0, 5e-5, 3e-4], START.rotation)
    once.target(goal, slow)
    for _ in range(2100):
        often.target(goal, slow)
        apart_m = often.tick().pose.position_m - once.tick().pose.position_m
        assert np.abs(apart_m).max() < AT_GOAL[0] / 10
    assert np.abs(often.motion.pose.position_m - goal.position_m).max() < AT_GOAL[0] / 10


@pytest.mark.parametrize("ticks", range(2, 9))
def test_on_a_line_the_axis_that_needs_most_jerk_decides_and_no_axis_gets_too_fast(
    ticks: int,
) -> None:
    most_m_s, line = 0.005, np.array([0.6034308, 0.3442121, -0.7192978])
    limits = MotionLimits((most_m_s, 2.0, 20.0), LIMITS.rotation)
    motion = Smoother(START, DT_S, limits)
    for part_m, shares, many in ((0.002, Shares(), ticks), (-0.001, Shares(0.5, 1.0, 0.3), 60)):
        motion.target(Pose(START.position_m + part_m * line, START.rotation), shares)
        for _ in range(many):
            assert np.abs(motion.tick().twist[:3]).max() <= most_m_s * (1 + LIMIT_RTOL)


def test_an_arm_that_goes_back_over_its_start_slowly_stays_on_its_line() -> None:
    motion, slow = smoother(), Shares(0.02, 0.01, 0.001)
    line = np.array([-0.39, 0.9, 0.156]) / norm3(np.array([-0.39, 0.9, 0.156]))

    def towards(part_m: float) -> None:
        # In the precision of a model's answer.
        way_m = (part_m * line).astype(np.float32).astype(np.float64)
        motion.target(Pose(START.position_m + way_m, START.rotation), slow)

    def here_m() -> float:
        return float((motion.motion.pose.position_m - START.position_m) @ line)

    towards(0.03)
    for _ in range(600):
        motion.tick()
    towards(here_m() + 2e-7)  # about to be passed
    motion.tick()
    beside_m = 0.0
    for _ in range(800):
        towards(here_m() - 2e-3)
        motion.tick()
        apart = motion.motion.pose.position_m - START.position_m
        beside_m = max(beside_m, norm3(apart - (apart @ line) * line))
    assert beside_m < 1e-6


@pytest.mark.parametrize("again", range(10, 80))
def test_an_arm_that_had_to_slow_down_keeps_to_its_lower_speed(again: int) -> None:
    slow, most = Shares(0.01, 1.0, 1.0), 0.01 * LIMITS.rotation[0]
    motion = smoother()
    far = Pose(START.position_m, START.rotation @ exp3(np.array([0.03, -0.015, 0.2])))
    motion.target(far, Shares(0.4))
    for _ in range(60):
        motion.tick()
    motion.target(far, slow, all_to_stop=True)
    for tick in range(250):
        if tick == again:
            motion.target(far, slow, all_to_stop=True)
        motion.tick()
    assert norm3(motion.motion.twist[3:]) <= most * (1 + LIMIT_RTOL)


def test_an_axis_that_turns_round_for_its_target_reaches_it_without_passing_it() -> None:
    little = Shares(0.1, 0.25, 0.125)
    motion = smoother()
    motion.target(Pose(START.position_m + [0.0, 0.0, 0.1], START.rotation), little)
    for _ in range(100):
        motion.tick()
    goal = Pose(motion.motion.pose.position_m - [1e-4, 0.0, 1e-3], START.rotation)
    lowest_m = np.inf
    for _ in range(600):  # the same target over and over, as while the joints hold back
        motion.target(goal, little)
        lowest_m = min(lowest_m, float(motion.tick().pose.position_m[2] - goal.position_m[2]))
    assert lowest_m > -AT_GOAL[0]
    assert motion.at_rest


@pytest.mark.parametrize("way_m", [0.0, 0.5 * PAUSE_LEAD_M, 5 * PAUSE_LEAD_M])
@pytest.mark.parametrize("way_rad", [0.0, 0.5 * PAUSE_LEAD_RAD, 8 * PAUSE_LEAD_RAD])
def test_the_goal_of_an_arm_that_is_held_is_on_its_way_and_no_further_than_it_can_retreat(
    way_m: float, way_rad: float
) -> None:
    path = PosePath(load_profile("panda_sim"))
    path.reset(START)
    way, turn = np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.0, 0.0])
    asked = Pose(START.position_m + way_m * way, exp3(way_rad * turn) @ START.rotation)
    near = path.near(Goal(asked, 0.04)).pose
    share = 1 / max(way_m / PAUSE_LEAD_M, way_rad / PAUSE_LEAD_RAD, 1.0)
    np.testing.assert_allclose(near.position_m, START.position_m + share * way_m * way, atol=1e-12)
    turned = log3(near.rotation @ START.rotation.T)
    np.testing.assert_allclose(turned, share * way_rad * turn, atol=1e-9)


def test_the_goal_of_an_arm_that_is_held_near_a_face_of_its_box_is_inside_it() -> None:
    path = PosePath(load_profile("panda_sim"))
    _, high = workspace_corners(load_profile("panda_sim").limits)
    path.reset(Pose(high - 0.001, START.rotation))
    near = path.near(Goal(Pose(high + 0.1, START.rotation), 0.04)).pose
    np.testing.assert_allclose(near.position_m, high, atol=1e-12)


def test_the_way_to_a_goal_is_along_the_rates_of_a_motion_that_goes_there() -> None:
    path = PosePath(load_profile("panda_sim"))
    path.reset(START)
    goal = Goal(Pose(START.position_m + [0.02, 0.05, 0.0], exp3([0.2, 0.3, 0.0])), 0.04)
    path.go_to(goal)
    for _ in range(20):
        path.tick()
    way, (rates, _) = path.way_to(goal), path.axis_rates()
    for part in (slice(0, 3), slice(3, 6)):
        along = way[part] @ rates[part] / norm3(way[part]) / norm3(rates[part])
        assert along == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_a_pause_on_a_curved_way_ends_inside_the_box(speed: float) -> None:
    """No axis waits for another to stop, and passes the face that it was to stop at."""
    of = load_profile("panda_sim")
    low, high = workspace_corners(of.limits)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        path = PosePath(of)
        path.reset(Pose(rng.uniform(low, high), START.rotation))
        for _ in range(3):
            here = path.motion.pose
            corner = np.clip(
                rng.choice([low, high]), here.position_m - 0.15, here.position_m + 0.15
            )
            goal = Goal(Pose(corner, exp3(rng.uniform(-0.2, 0.2, 3)) @ here.rotation), 0.0)
            path.go_to(goal, Shares(speed, speed**2, speed**3))
            for _ in range(int(rng.integers(5, 200))):
                path.tick()
        path.pause()
        while not path.at_rest:
            place = path.tick().pose.position_m
            assert (low - OUTSIDE_M <= place).all()
            assert (place <= high + OUTSIDE_M).all()
