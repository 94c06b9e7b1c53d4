"""The parts of the driver trossen that need neither the maker's library nor an arm."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from vla_zenoh_trossen.bounds import Bounds, JointBound
from vla_zenoh_trossen.hand import STARTS_S, Hand

from vla_zenoh.errors import MissingExtraError, ProfileError
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.python_driver import PythonDriver

NAMES = "base", "shoulder"
BOUNDS = Bounds(NAMES, [JointBound(-3.0, 3.0, 2.0), JointBound(0.0, 2.5, 1.0)])
PERIOD_S = 0.01
STROKE_M, FINGER_M_S = 0.044, 0.05
LATER_S = STARTS_S + 0.1


# -- limits of the controller ---------------------------------------------------------------------
def test_a_target_within_the_controllers_limits_is_sent() -> None:
    assert BOUNDS.why_not(np.array([0.01, 0.5]), np.array([0.0, 0.5]), PERIOD_S) == ""


def test_a_target_beyond_an_end_names_the_joint_and_both_ends() -> None:
    why = BOUNDS.why_not(np.array([0.0, 2.6]), np.array([0.0, 2.595]), PERIOD_S)
    assert why == "target of shoulder is 2.600 rad, the controller allows 0.000 to 2.500"


def test_a_target_that_is_too_far_for_its_time_names_the_speed() -> None:
    why = BOUNDS.why_not(np.array([0.0, 0.52]), np.array([0.0, 0.5]), PERIOD_S)
    assert "shoulder is 0.020 rad from the one 0.010 s before" in why
    assert "allows 1 rad/s" in why
    assert BOUNDS.why_not(np.array([0.0, 0.52]), np.array([0.0, 0.5]), 2 * PERIOD_S) == ""


def test_a_profile_may_not_allow_more_than_the_controller() -> None:
    allowed = BOUNDS.narrower_than(np.array([-3.0, 0.0]), np.array([3.0, 2.5]), np.ones(2))
    assert list(allowed) == []
    wider = list(BOUNDS.narrower_than(np.array([-3.0, 0.0]), np.array([3.0, 2.6]), np.full(2, 1.5)))
    assert len(wider) == 2
    assert (
        "shoulder may go from 0.000 to 2.600 rad, the controller allows 0.000 to 2.500" in wider[0]
    )
    assert "shoulder may turn at 1.5 rad/s, the controller allows 1" in wider[1]


def test_an_arm_that_rests_a_hair_beyond_an_end_is_held_at_the_end() -> None:
    np.testing.assert_array_equal(BOUNDS.inside(np.array([0.5, -1e-5])), [0.5, 0.0])


# -- the gripper ----------------------------------------------------------------------------------
def hand_at(travel_m: float) -> Hand:
    hand = Hand(STROKE_M, FINGER_M_S)
    hand.take(travel_m, 0.0)
    return hand


def test_an_opening_is_twice_the_travel_of_a_finger() -> None:
    hand = hand_at(0.02)
    assert hand.width_m == pytest.approx(0.04)
    travel_m, time_s = hand.ask(0.06, 0.04, 0.0)
    assert travel_m == pytest.approx(0.03)
    assert time_s == pytest.approx(0.5)


def test_fingers_are_not_asked_for_more_than_the_controller_allows() -> None:
    travel_m, time_s = hand_at(0.0).ask(0.1, 1.0, 0.0)
    assert travel_m == STROKE_M
    assert time_s == pytest.approx(STROKE_M / FINGER_M_S)


def test_fingers_that_stop_before_they_are_shut_hold_something() -> None:
    hand = hand_at(0.04)
    hand.ask(0.0, 0.1, 0.0)
    hand.take(0.02, 0.05)
    assert hand.moving(LATER_S)
    assert not hand.holding(LATER_S)
    hand.take(0.015, 0.0)
    assert hand.holding(LATER_S)
    hand.take(0.0, 0.0)
    assert not hand.holding(LATER_S)


def test_fingers_that_were_opened_hold_nothing() -> None:
    hand = hand_at(0.01)
    hand.ask(0.08, 0.1, 0.0)
    hand.take(0.03, 0.0)
    assert not hand.holding(LATER_S)


# -- the profile ----------------------------------------------------------------------------------
def refused(folder: Path, text: str) -> str:
    path = folder / "lab.yaml"
    path.write_text(f"extends: widowx_ai\n{text}\n")
    with pytest.raises(ProfileError) as error:
        load_profile(str(path))
    return str(error.value)


def test_an_arm_of_another_count_of_joints_is_refused(tmp_path: Path) -> None:
    told = refused(tmp_path, "robot: {arm_joints: [joint_0, joint_1], home_rad: [0.0, 1.0]}")
    assert "has not the six joints of a WidowX AI" in told


def test_an_opening_that_the_fingers_do_not_have_is_refused(tmp_path: Path) -> None:
    told = refused(tmp_path, "robot: {gripper: {max_width_m: 0.1}}")
    assert "is 0.1, but the fingers of a WidowX AI open to 0.088" in told


def test_poses_are_refused(tmp_path: Path) -> None:
    assert "joint" in refused(tmp_path, "robot: {command: pose}")


@pytest.mark.skipif(find_spec("trossen_arm") is not None, reason="the maker's library is there")
def test_without_the_makers_library_it_says_what_to_install() -> None:
    with pytest.raises(MissingExtraError, match=r"vla-zenoh-trossen\[arm\]"):
        PythonDriver(load_profile("widowx_ai"))
