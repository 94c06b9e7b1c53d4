"""A robot's state as the numbers a policy was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from vla_zenoh_policy_servers import state_vector
from vla_zenoh_policy_servers.action_semantics import METRIC, StateUnits
from vla_zenoh_policy_servers.state_vector import StateNumbers

from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, ModelSpec, Observation, ObservationSpec, StatePart
from vla_zenoh.types import GripperState, JointState, PoseState

ATOL = 1e-6
"""Of rotation matrices; extrinsic angles lose digits near a pitch of 90 degrees."""
MAX_WIDTH_M = 0.08
PANDA, UR = 7, 6
"""Joints of arms."""


def in_numbers(
    names: Sequence[str], joints: int = PANDA, units: StateUnits = METRIC
) -> StateNumbers:
    arm = tuple(f"joint{number}" for number in range(1, joints + 1))
    return StateNumbers(tuple(names), arm, MAX_WIDTH_M, units)


def seen(quat_xyzw: Any = (0, 0, -(0.5**0.5), -(0.5**0.5)), width_m: float = 0.02) -> Observation:
    spec = ModelSpec(
        name="all",
        observation=ObservationSpec(state=("joint", "pose", "gripper", "wrench", "effort")),
        action=ActionSpec(horizon=1, dt_s=0.1),
    )
    return replace(
        example_observation(spec),
        pose=PoseState(np.array([0.4, 0.1, 0.3]), np.array(quat_xyzw), np.zeros(6)),
        gripper=GripperState(width_m=width_m, moving=False, holding=False),
    )


def test_parts_come_in_the_order_they_are_named() -> None:
    names = state_vector.read_state(
        "gripper_closed+zero+fingers_m+position+rotvec+gripper_m", 11, PANDA
    )
    numbers = in_numbers(names).encode(seen())
    wanted = [0.75, 0, 0.01, -0.01, 0.4, 0.1, 0.3, 0, 0, np.pi / 2, 0.02]
    np.testing.assert_allclose(numbers, wanted, atol=ATOL)
    assert numbers.dtype == np.float32
    assert state_vector.parts_of(names) == ("gripper", "pose")


def test_every_part_has_as_many_numbers_as_it_says() -> None:
    for name in state_vector.PARTS:
        numbers = in_numbers([name]).encode(seen())
        assert len(numbers) == state_vector.size_of(name, PANDA)


def test_every_part_of_the_state_that_a_robot_reports_has_a_name_in_a_data_set() -> None:
    named = {part for part, _ in state_vector.PARTS.values() if part is not None}
    assert named == {*get_args(StatePart)} - {"privileged"}


@pytest.mark.parametrize("joints", [UR, PANDA])
@pytest.mark.parametrize(("part", "unit"), [("joint", 1.0), ("joint_deg", 180 / np.pi)])
def test_joints_are_as_many_as_the_arm_has(joints: int, part: str, unit: float) -> None:
    names = state_vector.read_state(f"{part}+gripper_open", joints + 1, joints)
    zeros = np.zeros(joints)
    told = in_numbers(names, joints)
    arm = JointState(told.joints, np.arange(joints) / 10, zeros, zeros)
    numbers = told.encode(replace(seen(), joint=arm))
    wanted = unit * np.arange(joints) / 10
    np.testing.assert_allclose(numbers, [*wanted, 0.25], rtol=ATOL)
    back = told.decode(numbers.astype(float))
    np.testing.assert_allclose(back["joint"], arm.position_rad, atol=ATOL)
    with pytest.raises(SpecError, match=rf"has 9 numbers, 'joint' has {joints}; .*\({joints}\)"):
        state_vector.read_state("joint", 9, joints)


@given(
    rotvec=hnp.arrays(np.float64, 3, elements=st.floats(-3.0, 3.0)),
    width_m=st.floats(0, MAX_WIDTH_M),
    turn=st.sampled_from(tuple(state_vector.ROTATIONS)),
    grip=st.sampled_from(tuple(state_vector.GRIPPERS)),
)
@example(np.zeros(3), 0.0, "rotvec", "gripper_m")
def test_a_state_in_any_form_is_read_back(
    rotvec: np.ndarray[Any, Any], width_m: float, turn: str, grip: str
) -> None:
    quat = quat_from_rotation(exp3(rotvec))
    names = state_vector.read_parts(f"position+{turn}+zero*2+{grip}")
    told = in_numbers(names)
    back = told.decode(told.encode(seen(quat, width_m)).astype(float))
    np.testing.assert_allclose(back["position_m"], [0.4, 0.1, 0.3], atol=ATOL)
    assert abs(back["quat_xyzw"] @ quat) == pytest.approx(1.0, abs=1e-5)
    assert back["width_m"] == pytest.approx(width_m, abs=ATOL)


@pytest.mark.parametrize("whole", state_vector.COORDINATES)
def test_single_coordinates_are_those_of_the_whole(whole: str) -> None:
    names = state_vector.COORDINATES[whole]
    observation = seen(quat_from_rotation(exp3(np.array([0.1, -0.2, 0.3]))))
    np.testing.assert_array_equal(
        in_numbers(names).encode(observation), in_numbers([whole]).encode(observation)
    )


def test_what_says_too_little_is_not_read_back() -> None:
    with pytest.raises(SpecError, match="roll alone says too little"):
        in_numbers(["roll"]).decode(np.zeros(1))
    with pytest.raises(SpecError, match=r"rpy has shape \(2,\), wanted \(3,\)"):
        in_numbers(["rpy"]).decode(np.zeros(2))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("position+grip", r"called 'grip'; there are: joint \(one for each"),
        ("position+", r"called ''; there are"),
        ("position", r"state has 8 numbers, 'position' has 3"),
        ("", r"state has 8 numbers, '' has 0"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(text: str, match: str) -> None:
    with pytest.raises(SpecError, match=match):
        state_vector.read_state(text, 8, PANDA)


def test_a_part_that_was_not_observed_is_named_and_no_zero() -> None:
    for name, part in (("joint", "joint"), ("gripper_open", "gripper"), ("rotvec", "pose")):
        blind = replace(seen(), joint=None, pose=None, gripper=None)
        with pytest.raises(SpecError, match=f"has no {part}, of which '{name}' is a part"):
            in_numbers([name]).encode(blind)


def test_joints_are_told_in_the_order_of_the_profile_whatever_that_of_the_state() -> None:
    told = in_numbers(["joint"])
    turned = JointState(told.joints[::-1], np.arange(7.0), np.zeros(7), np.zeros(7))
    numbers = told.encode(replace(seen(), joint=turned))
    np.testing.assert_array_equal(numbers, np.arange(7.0)[::-1])
    other = JointState(("a", "b"), np.zeros(2), np.zeros(2), np.zeros(2))
    with pytest.raises(SpecError, match=r"no joint joint1, .*; it has a, b"):
        told.encode(replace(seen(), joint=other))
