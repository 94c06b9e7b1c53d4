"""Bounds on steps and goals: they shorten and tell, or refuse what must be a mistake."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.control.limits import bound_step, full_speed_s, into_workspace, leash
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3, log3, norm3
from vla_zenoh.profile import REJECT_FACTOR, Limits

LIMITS = Limits()
RTOL = 1e-5  # steps travel as float32
ATOL = 1e-9
BEFORE = Pose(np.array([0.45, 0.0, 0.3]), exp3(np.array([3.0, 0.0, 0.3])))

box = LIMITS.workspace
inside = st.tuples(st.floats(*box.x_m), st.floats(*box.y_m), st.floats(*box.z_m)).map(np.array)
ways = st.tuples(*[st.floats(-0.19, 0.19)] * 3).map(np.array)
turns = st.tuples(*[st.floats(-0.8, 0.8)] * 3).map(np.array)


def is_inside(position_m: np.ndarray) -> bool:
    return all(
        low <= value <= high
        for value, (low, high) in zip(position_m, (box.x_m, box.y_m, box.z_m), strict=True)
    )


@given(inside, ways, turns)
def test_a_bounded_step_is_short_and_inside_and_points_the_same_way(
    position_m: np.ndarray, way: np.ndarray, turn: np.ndarray
) -> None:
    before = Pose(position_m, BEFORE.rotation)
    pose, hits = bound_step(LIMITS, before, Pose(position_m + way, exp3(turn) @ before.rotation))
    assert is_inside(pose.position_m)
    moved, turned = pose.position_m - position_m, log3(pose.rotation @ before.rotation.T)
    assert norm3(moved) <= LIMITS.step_m * (1 + RTOL)
    assert norm3(turned) <= LIMITS.step_rad * (1 + RTOL)
    assert norm3(np.cross(turned, turn)) < 1e-6
    names = {hit.name for hit in hits}
    assert ("step_m" in names) == (norm3(way) > LIMITS.step_m * (1 + 1e-6))
    assert ("step_rad" in names) == (norm3(turn) > LIMITS.step_rad * (1 + 1e-6))
    if "workspace" not in names:
        assert norm3(np.cross(moved, way)) < 1e-9


@given(ways, turns)
def test_a_step_takes_as_long_back_as_forth(way: np.ndarray, turn: np.ndarray) -> None:
    after = Pose(BEFORE.position_m + way, exp3(turn) @ BEFORE.rotation)
    forth_s, back_s = full_speed_s(LIMITS, BEFORE, after), full_speed_s(LIMITS, after, BEFORE)
    assert forth_s == pytest.approx(back_s)
    assert forth_s >= np.abs(way).max() / LIMITS.translation.velocity_m_s * (1 - ATOL)
    assert forth_s >= norm3(turn) / 2 / LIMITS.rotation.velocity_rad_s


def test_a_step_within_all_bounds_is_not_touched() -> None:
    asked = Pose(BEFORE.position_m + [0.01, 0.0, 0.02], exp3([0.0, 0.1, 0.0]) @ BEFORE.rotation)
    pose, hits = bound_step(LIMITS, BEFORE, asked)
    assert hits == []
    np.testing.assert_array_equal(pose.position_m, asked.position_m)
    np.testing.assert_array_equal(pose.rotation, asked.rotation)


def test_a_step_of_exactly_the_limit_in_float32_is_within_it() -> None:
    way = np.array([np.float32(LIMITS.step_m), 0.0, 0.0], np.float64)
    _, hits = bound_step(LIMITS, BEFORE, Pose(BEFORE.position_m + way, BEFORE.rotation))
    assert hits == []


@pytest.mark.parametrize("factor", [REJECT_FACTOR * 1.01, 1e3, 1e30, np.inf, np.nan])
def test_a_step_many_times_its_limit_is_shortened_to_it_or_to_nothing(factor: float) -> None:
    way = np.array([0.0, 0.0, LIMITS.step_m * factor])
    pose, hits = bound_step(LIMITS, BEFORE, Pose(BEFORE.position_m + way, BEFORE.rotation))
    assert any(hit.name == "step_m" for hit in hits)
    assert norm3(pose.position_m - BEFORE.position_m) <= LIMITS.step_m * (1 + 1e-9)


def test_a_step_somewhat_over_its_limit_is_shortened_and_told_with_value_and_limit() -> None:
    asked = Pose(BEFORE.position_m + [0.0, 0.1, 0.0], BEFORE.rotation)
    pose, hits = bound_step(LIMITS, BEFORE, asked)
    np.testing.assert_allclose(pose.position_m, [0.45, LIMITS.step_m, 0.3], atol=ATOL)
    (hit,) = hits
    assert hit.name == "step_m"
    assert (hit.value, hit.limit) == (pytest.approx(0.1), LIMITS.step_m)


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array))
def test_into_workspace_finds_the_nearest_point_of_the_box(position_m: np.ndarray) -> None:
    nearest, outside_m = into_workspace(LIMITS, position_m)
    assert is_inside(nearest)
    assert outside_m == pytest.approx(norm3(nearest - position_m))
    assert (outside_m == 0.0) == is_inside(position_m)
    low, high = np.transpose([box.x_m, box.y_m, box.z_m])
    np.testing.assert_allclose(nearest, np.clip(position_m, low, high), atol=ATOL)


@given(inside, inside, turns)
def test_the_leash_keeps_the_goal_near_and_inside(
    goal_m: np.ndarray, commanded_m: np.ndarray, turn: np.ndarray
) -> None:
    goal, commanded = Pose(goal_m, exp3(turn) @ BEFORE.rotation), Pose(commanded_m, BEFORE.rotation)
    held, hits = leash(LIMITS, goal, commanded)
    assert norm3(held.position_m - commanded_m) <= LIMITS.lead_m * (1 + RTOL)
    assert angle_between(commanded.rotation, held.rotation) <= LIMITS.lead_rad * (1 + RTOL)
    _, outside_m = into_workspace(LIMITS, held.position_m)
    assert outside_m < ATOL
    far = norm3(goal_m - commanded_m) > LIMITS.lead_m or norm3(turn) > LIMITS.lead_rad
    assert bool(hits) == far
    if not far:
        assert held is goal
