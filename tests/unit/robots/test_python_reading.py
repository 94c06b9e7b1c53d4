"""What a robot in a Python file says: taken whole or not at all, and its faults."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import load_profile
from vla_zenoh.robot import Reading
from vla_zenoh.robots.joint_reading import JointReading
from vla_zenoh.robots.python_driver import FAULT_NS, MAX_WORDS, Fault, measurement_of
from vla_zenoh.types import JointState

PROFILE = load_profile("panda_sim")
KINEMATICS = make_kinematics(PROFILE)
HOME_RAD = np.array(PROFILE.robot.home_rad)
STAMP_NS = 1_700_000_000_000_000_000
ASKED_M = 0.03
GOOD = Reading(HOME_RAD, width_m=0.05, moving=True, wrench=np.arange(6.0))


def test_a_reading_that_holds_becomes_our_records() -> None:
    taken = measurement_of(GOOD, STAMP_NS, ASKED_M, JointReading(PROFILE, KINEMATICS))
    np.testing.assert_array_equal(taken.joints.position_rad, HOME_RAD)
    np.testing.assert_array_equal(taken.pose.position_m, taken.tcp.position_m)
    np.testing.assert_array_equal(taken.pose.wrench, np.arange(6.0))
    assert (taken.gripper.width_m, taken.gripper.moving, taken.gripper.holding) == (0.05, True, 0)
    assert taken.stamp_ns == STAMP_NS


PER_JOINT = [each.name for each in fields(JointState) if each.name in Reading.__annotations__]


@pytest.mark.parametrize("name", PER_JOINT)
def test_what_a_reading_says_of_each_joint_is_in_the_joint_state(name: str) -> None:
    said = HOME_RAD + 0.01 * np.arange(1, 8)
    reading = replace(GOOD, **{name: said})
    taken = measurement_of(reading, STAMP_NS, ASKED_M, JointReading(PROFILE, KINEMATICS))
    np.testing.assert_array_equal(getattr(taken.joints, name), said)


def test_an_arm_that_does_not_say_its_width_is_believed_to_be_where_it_was_asked_to_be() -> None:
    arm = JointReading(PROFILE, KINEMATICS)
    taken = measurement_of(replace(GOOD, width_m=None), STAMP_NS, ASKED_M, arm)
    assert taken.gripper.width_m == ASKED_M


@pytest.mark.parametrize(
    ("nonsense", "why"),
    [
        ({"width_m": float("nan")}, "width_m"),
        ({"width_m": "wide"}, "width_m"),
        ({"width_m": 3.0}, "width_m"),
        ({"moving": "no"}, "moving"),
        ({"holding": None}, "holding"),
        ({"wrench": [float("nan")] * 6}, "wrench"),
        ({"wrench": [1.0]}, "wrench has shape"),
        ({"position_rad": HOME_RAD + float("nan")}, "position"),
        ({"position_rad": HOME_RAD[:6]}, "position_rad has shape"),
        ({"velocity_rad_s": HOME_RAD + float("inf")}, "velocity"),
        ({"effort_nm": "none"}, "effort_nm is not a list"),
    ],
)
def test_what_does_not_hold_is_refused_by_name(nonsense: dict[str, Any], why: str) -> None:
    arm = JointReading(PROFILE, KINEMATICS)
    with pytest.raises(ValueError, match=why):
        measurement_of(replace(GOOD, **nonsense), STAMP_NS, ASKED_M, arm)
    measurement_of(GOOD, STAMP_NS + 1, ASKED_M, arm)


def test_a_fault_lasts_until_the_robot_is_well_and_long_enough_to_be_heard() -> None:
    fault = Fault()
    assert not fault.say("", 0)
    assert fault.say("reflex", 1)
    assert not fault.say("reflex", 2)
    assert not fault.say("", FAULT_NS)
    assert fault.words == "reflex"
    assert fault.say(None, FAULT_NS + 2)
    assert fault.words == ""


def test_a_fault_of_which_nothing_more_is_said_lasts() -> None:
    fault = Fault()
    fault.say("reflex", 0)
    assert not fault.say("reflex", 100 * FAULT_NS)
    assert not fault.say("", 101 * FAULT_NS - 1)
    assert fault.words == "reflex"


def test_another_fault_takes_its_place_at_once() -> None:
    fault = Fault()
    fault.say("reflex", 0)
    assert fault.say("user stop", 1)
    assert fault.words == "user stop"


def test_words_of_a_fault_are_short_and_steer_no_terminal() -> None:
    fault = Fault()
    fault.say("\udc80\x1b[2J" * MAX_WORDS, 0)
    assert len(fault.words) <= MAX_WORDS
    assert fault.words.isprintable()
    fault.words.encode()
