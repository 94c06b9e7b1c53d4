"""When a primitive is over: arrivals, grips and the conditions of a run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from vla_zenoh_primitives.endings import (
    GRIPPED_S,
    SETTLED_S,
    STUCK_S,
    Arrival,
    Ending,
    Gripped,
    RunEnding,
    Sight,
)
from vla_zenoh_primitives.requests import Until

from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.types import GripperState, PoseState

PERIOD_S = 0.01
MOST_M = 0.08


def sight(now_s: float, **state: Any) -> Sight:
    twist = [state.get("speed_m_s", 0.0), 0, 0, 0, 0, 0]
    force = state.get("force_n")
    return Sight(
        now_s,
        PoseState(
            [state.get("x_m", 0.0), 0, 0],  # pyright: ignore[reportArgumentType]
            [0, 0, 0, 1],  # pyright: ignore[reportArgumentType]
            twist,  # pyright: ignore[reportArgumentType]
            None if force is None else [force, 0, 0, 0, 0, 0],  # pyright: ignore
        ),
        np.array([state.get("joint_rad", 0.0)]),
        GripperState(
            state.get("width_m", 0.04), state.get("moving", False), state.get("holding", False)
        ),
        state.get("done", False),
        state.get("speed", 1.0),
    )


def over(ending: Ending, seconds: float, begin_s: float = 0.0, **state: Any) -> str:
    """What it says within a time in which nothing changes."""
    for number in range(int(seconds / PERIOD_S) + 2):
        if found := ending.check(sight(begin_s + number * PERIOD_S, **state)):
            return found
    return ""


def at(x_m: float) -> Pose:
    return Pose(np.array([x_m, 0.0, 0.0]), np.eye(3))


def test_a_target_is_reached_when_the_arm_rests_there() -> None:
    arrival = Arrival(at(0.5))
    assert over(arrival, 0.5, x_m=0.5, speed_m_s=0.1) == ""
    assert over(arrival, SETTLED_S, 1.0, x_m=0.5004) == "reached"


def test_passing_the_target_is_no_arrival() -> None:
    arrival = Arrival(at(0.5))
    for number in range(100):
        x_m = 0.45 + 0.001 * number
        assert arrival.check(sight(number * PERIOD_S, x_m=x_m, speed_m_s=0.1)) == ""


def test_an_arm_that_makes_no_way_is_bound_and_later_where_it_goes_slowly() -> None:
    assert over(Arrival(at(0.5)), STUCK_S, x_m=0.48) == "bound"
    assert over(Arrival(at(0.5)), 2 * STUCK_S, x_m=0.48, speed=0.3) == ""


def test_a_slow_arm_that_makes_way_is_not_bound() -> None:
    arrival = Arrival(at(0.5))
    for number in range(1000):
        x_m = 0.5 - 0.2 * 0.995**number
        assert arrival.check(sight(number * PERIOD_S, x_m=x_m, speed_m_s=0.01)) == ""


def test_joints_are_judged_where_they_are_commanded() -> None:
    arrival = Arrival(at(0.5), np.array([1.0]))
    assert over(arrival, 2 * SETTLED_S, x_m=0.5, joint_rad=0.9) == ""
    assert over(arrival, SETTLED_S, 1.0, x_m=0.499, joint_rad=1.0005) == "reached"


def test_a_grip_ends_where_the_fingers_rest() -> None:
    assert over(Gripped(0.03, closing=False), 2 * GRIPPED_S, width_m=0.03, moving=True) == ""
    assert over(Gripped(0.03, closing=False), GRIPPED_S, width_m=0.03) == "reached"
    assert over(Gripped(0.03, closing=False), GRIPPED_S, width_m=0.05) == "bound"
    assert over(Gripped(0.0, closing=True), GRIPPED_S, width_m=0.05) == "reached"


def test_a_grip_does_not_end_while_the_width_changes_though_the_robot_says_nothing_of_it() -> None:
    grip = Gripped(0.0, closing=True)
    widths_m = [*np.arange(0.08, 0.03, -0.02 * PERIOD_S), *[0.03 + 1e-4] * 500]
    ends = [grip.check(sight(n * PERIOD_S, width_m=width_m)) for n, width_m in enumerate(widths_m)]
    rests = len(widths_m) - 500
    assert not any(ends[:rests])
    assert ends[-1] == "reached"


@pytest.mark.parametrize(
    ("until", "before", "after"),
    [
        ({"gripper": "closed"}, {"width_m": 0.04}, {"width_m": 0.04, "holding": True}),
        ({"gripper": "closed"}, {"width_m": 0.04}, {"width_m": 0.001}),
        ({"gripper": "open"}, {"width_m": 0.079, "moving": True}, {"width_m": 0.079}),
        ({"done": True}, {}, {"done": True}),
        ({"force_n": 5.0}, {"force_n": 30.0}, {"force_n": 36.0}),
        (
            {"inside": {"low_m": [0.1, -1, -1], "high_m": [0.2, 1, 1]}},
            {"x_m": 0.09},
            {"x_m": 0.15},
        ),
    ],
)
def test_a_run_ends_by_its_condition(
    until: dict[str, Any], before: dict[str, Any], after: dict[str, Any]
) -> None:
    ending = RunEnding(Until.model_validate_json(json.dumps(until)), MOST_M)
    assert over(ending, 1.0, **before) == ""
    assert over(ending, 0.1, 2.0, **after) == next(iter(until))


def test_standing_still_counts_after_the_first_motion_only() -> None:
    ending = RunEnding(Until(still_s=1.0), MOST_M)
    assert over(ending, 5.0) == ""
    assert over(ending, 0.1, 6.0, speed_m_s=0.1) == ""
    assert over(ending, 0.5, 6.2) == ""
    assert over(ending, 0.5, 6.8) == "still_s"


def test_a_run_without_conditions_goes_on() -> None:
    assert over(RunEnding(Until(), MOST_M), 5.0, done=True) == ""
