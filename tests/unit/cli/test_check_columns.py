"""Names of the columns that `check` shows, for every form of a step."""

from __future__ import annotations

from typing import get_args

import pytest

from vla_zenoh.lab.cli.check import column_names
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.spec import Rotation

JOINTS = ActionSpec(horizon=1, dt_s=0.1, space="joint", joints=("a", "b"))


@pytest.mark.parametrize("rotation", get_args(Rotation))
def test_every_number_of_a_step_has_a_name(rotation: Rotation) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, kind="absolute", rotation=rotation)
    assert len(set(column_names(action))) == action.dimension


def test_the_numbers_of_parts_have_the_names_of_their_parts() -> None:
    action = ActionSpec.of_parts({"left": JOINTS, "right": JOINTS})
    assert len(set(column_names(action))) == action.dimension
    assert column_names(action)[:3] == ["left a rad", "left b rad", "left gripper"]
