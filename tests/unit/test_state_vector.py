"""A robot's state as the numbers a policy was trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from vla_zenoh import state_vector
from vla_zenoh.control.so3 import exp3, rotation_from_quat, rotation_from_rpy
from vla_zenoh.errors import SpecError
from vla_zenoh.policy import (
    ActionSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
    example_observation,
)
from vla_zenoh.types import GripperState, PoseState

ATOL = 1e-6
"""Of rotation matrices; extrinsic angles lose digits near a pitch of 90 degrees."""
MAX_WIDTH_M = 0.08


def seen() -> Observation:
    spec = ModelSpec(
        name="all",
        observation=ObservationSpec(state=("joint", "pose", "gripper")),
        action=ActionSpec(horizon=1, dt_s=0.1),
    )
    half = np.sqrt(0.5)
    return replace(
        example_observation(spec),
        pose=PoseState(np.array([0.4, 0.1, 0.3]), np.array([0, 0, -half, -half]), np.zeros(6)),
        gripper=GripperState(width_m=0.02, moving=False, holding=False),
    )


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
@example([1.0, 0.0, 1.0, 0.0])
@example([0.0, 1.0, 0.0, 1.0])
@example([0.1, 1.0, 0.1, 1.0 + 1e-9])
@example([0.3, -1.0, 0.3, 1.0])
def test_all_forms_of_a_rotation_are_the_same_rotation(numbers: list[float]) -> None:
    length = float(np.linalg.norm(numbers))
    assume(length > 0.1)
    unit = [value / length for value in numbers]
    wanted = rotation_from_quat(np.array(unit))
    w, *axis = state_vector.quat_wxyz(unit)
    assert w >= 0
    for same in (
        rotation_from_quat(np.array(state_vector.quat_xyzw(unit))),
        rotation_from_quat(np.array([*axis, w])),
        exp3(np.array(state_vector.rotvec(unit))),
        rotation_from_rpy(np.array(state_vector.rpy(unit))),
    ):
        np.testing.assert_allclose(same, wanted, atol=ATOL)


def test_parts_come_in_the_order_they_are_named() -> None:
    names = state_vector.read_state("gripper_closed+zero+fingers_m+position+rotvec+gripper_m", 11)
    numbers = state_vector.state_vector(names, seen(), MAX_WIDTH_M)
    wanted = [0.75, 0, 0.01, -0.01, 0.4, 0.1, 0.3, 0, 0, np.pi / 2, 0.02]
    np.testing.assert_allclose(numbers, wanted, atol=ATOL)
    assert numbers.dtype == np.float32
    assert state_vector.parts_of(names) == ("gripper", "pose")


def test_every_part_has_as_many_numbers_as_it_says() -> None:
    for name, (_, size) in state_vector.PARTS.items():
        assert len(state_vector.state_vector([name], seen(), MAX_WIDTH_M)) == size


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("position+grip", r"called 'grip'; there are: joint \(7\)"),
        ("position", r"state has 8 numbers, 'position' has 3"),
        ("", r"state has 8 numbers, '' has 0"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(text: str, match: str) -> None:
    with pytest.raises(SpecError, match=match):
        state_vector.read_state(text, 8)
