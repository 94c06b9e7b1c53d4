"""A robot whose profile declares no gripper has none anywhere: no number, and a refusal by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from command_rig import model_spec
from other_arms import ur5
from vla_zenoh_policy_servers.state_vector import state_numbers

from vla_zenoh.control.actions import step_width
from vla_zenoh.control.commanded_part import CommandedPart
from vla_zenoh.control.policy_check import spec_errors
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import load_profile, override
from vla_zenoh.robot import Reading
from vla_zenoh.robots.joint_reading import JointReading
from vla_zenoh.robots.python_driver import measurement_of
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import HeldBox

BARE = ur5()
GRIPS = ActionSpec(horizon=1, dt_s=0.1, gripper="binary")
STAMP_NS = 1_700_000_000_000_000_000


def _reading(**more: Any) -> Any:
    arm = JointReading(BARE, make_kinematics(BARE))
    reading = Reading(position_rad=BARE.robot.home_rad, **more)
    return measurement_of(reading, STAMP_NS, BARE.robot.max_width_m, arm).gripper


REFUSALS: dict[str, Callable[[], object]] = {
    "finger joints without a gripper": lambda: override(
        load_profile("panda_sim"), {"robot": {"gripper": None}}
    ),
    "a ROS 2 gripper without one": lambda: override(
        load_profile("panda_ros2"), {"robot": {"gripper": None, "finger_joints": []}}
    ),
    "what needs one": lambda: BARE.robot.require_gripper("this"),
    "a step of a model": lambda: step_width(GRIPS, np.zeros(7), 0.0, BARE.robot.max_width_m),
    "a box in the gripper": lambda: CommandedPart(ur5("pose"), None).hold(HeldBox((0.1, 0.1, 0.1))),
    "a command in the simulator": lambda: build_world(BARE).set_gripper(0.0, 0.1, 10.0),
    "a width that the arm reports": lambda: _reading(width_m=0.08),
    "a state vector with it": lambda: state_numbers(["joint", "gripper_open"], BARE),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_what_wants_a_gripper_is_refused_by_name(what: str) -> None:
    with pytest.raises((VlaZenohError, ValueError), match="gripper"):
        REFUSALS[what]()


def test_a_model_that_grips_is_refused_by_check_and_activation() -> None:
    (found,) = [each for each in spec_errors(BARE, model_spec()) if each.name == "gripper"]
    assert found.level == "error"
    assert "robot 'ur5' has no gripper" in found.why
    assert 'gripper="none"' in found.why


@pytest.mark.parametrize("state", [_reading, lambda: build_world(BARE).gripper_state()])
def test_no_width_is_made_up(state: Callable[[], Any]) -> None:
    record = state()
    assert record.width_m is None
    assert math.isnan(record.opening_m)
    assert not record.moving
    assert not record.holding


def test_a_commanded_arm_has_no_gripper_to_send_to() -> None:
    assert CommandedPart(ur5("pose"), None).gripper is None
