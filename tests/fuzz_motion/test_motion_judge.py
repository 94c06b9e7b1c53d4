"""The judge of the motion fuzz sees what it is to see, and reckons as the smoother does."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from motion_case import Case, make_case
from motion_judge import (
    WANDER_M,
    Judge,
    axis_limits,
    brake_range,
    from_quat,
    log_of,
    stop_time_s,
    wander,
)
from motion_rig import Rig, Trace
from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation

STATES, PLACES = 300, 400
LIMITS = np.array([0.5, 2.0, 20.0])
ROUNDING = 1e-12


def test_brakes_go_as_far_and_as_long_as_the_smoothers() -> None:
    rng = random.Random(0)
    for _ in range(STATES):
        v, a = rng.uniform(-0.5, 0.5), rng.choice([0.0, rng.uniform(-2.0, 2.0)])
        ask, path = InputParameter(1), Trajectory(1)
        ask.control_interface = ControlInterface.Velocity
        ask.current_position, ask.current_velocity, ask.current_acceleration = [0.0], [v], [a]
        ask.target_velocity = ask.target_acceleration = [0.0]
        ask.max_acceleration, ask.max_jerk = [LIMITS[1]], [LIMITS[2]]
        Ruckig(1).calculate(ask, path)
        way = [path.at_time(n * path.duration / PLACES)[0][0] for n in range(PLACES + 1)]
        low, high = brake_range(np.zeros(1), np.array([v]), np.array([a]), LIMITS)
        assert abs(low[0] - min(way)) < WANDER_M
        assert abs(high[0] - max(way)) < WANDER_M
        known_s = stop_time_s(np.array([[v]]), np.array([[a]]), LIMITS[:, None])[0, 0]
        assert known_s >= path.duration - ROUNDING


def test_rotations_are_read_as_elsewhere() -> None:
    rng = np.random.default_rng(0)
    turns = [vector for vector in rng.normal(size=(50, 3)) if np.linalg.norm(vector) < 3.0]
    rotation = np.array([exp3(vector) for vector in turns])
    assert np.allclose(log_of(rotation), turns, atol=1e-12)
    quats = np.array([quat_from_rotation(each) for each in rotation])
    assert np.allclose(from_quat(quats), rotation, atol=1e-12)


def test_an_axis_that_leaves_its_goal_is_seen_and_one_that_follows_it_is_not() -> None:
    still, goal = np.zeros(10), np.zeros(10)
    place, on = np.zeros(10), np.ones(10, bool)
    place[6] = 3e-5
    assert wander(goal, place, still, still, on).max() == pytest.approx(3e-5)
    assert wander(place.copy(), place, still, still, on).max() == 0.0
    on[6] = False
    assert wander(goal, place, still, still, on).max() == 0.0


def test_a_step_in_a_command_is_seen_but_not_where_nobody_follows_or_the_robot_misleads() -> None:
    case = make_case("pose", 1)
    trace = Rig(case).run(600)
    at = next(i for i, tick in enumerate(trace.ticks) if i > 300 and tick.record is not None)
    assert "command translation velocity" not in names(case, trace)
    whole = list(trace.ticks)
    for anchored, followed, misled, seen in (
        (False, True, False, True),
        (True, True, False, True),
        (True, False, False, False),
        (True, True, True, False),
        (False, True, True, True),
    ):
        trace.ticks = [
            tick if i < at else tick._replace(record=moved(tick.record))
            for i, tick in enumerate(whole)
        ]
        changed = {"anchored": anchored, "followed": followed, "misled": misled}
        trace.ticks[at] = trace.ticks[at]._replace(**changed)
        assert ("command translation velocity" in names(case, trace)) is seen


def names(case: Case, trace: Trace) -> set[str]:
    return {found.name for found in Judge(case, trace).judge()}


def moved(record: Any) -> Any:
    """The command, 5 mm aside."""
    return replace(record, position_m=record.position_m + 0.005)


def test_limits_are_those_of_the_profile() -> None:
    limits = axis_limits(make_case("joint", 1).profile.limits)
    assert limits.shape == (3, 6)
    assert limits[0, 0] == 0.5
