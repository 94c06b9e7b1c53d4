"""What the answers of a model have in common."""

from __future__ import annotations

import numpy as np
import pytest

from vla_zenoh.lab.check import judge
from vla_zenoh.lab.check.examples import ExampleStyle, chart
from vla_zenoh.policy import ActionSpec, Rotation

STEP = 0.02


def found(rotation: Rotation, step: list[float]) -> set[str]:
    action = ActionSpec(horizon=1, dt_s=0.1, rotation=rotation, gripper="none")
    example_styles = [(ExampleStyle("chart", picture=chart), np.array([step], np.float32))]
    return {finding.name for finding in judge.behaviour(action, example_styles, {})}


@pytest.mark.parametrize(
    ("rotation", "step"),
    [
        ("rpy", [0, 0, 0, 0, STEP, 0]),
        ("rotvec", [0, 0, 0, 0, 0, STEP]),
        ("quaternion", [0, 0, 0, STEP, 0, 0, 1]),
        ("rpy", [0, STEP, 0, 0, 0, 0]),
    ],
)
def test_a_model_that_moves_or_only_turns_does_not_stand_still(
    rotation: Rotation, step: list[float]
) -> None:
    assert "stands_still" not in found(rotation, step)


@pytest.mark.parametrize(
    ("rotation", "step"), [("rpy", [0] * 6), ("quaternion", [0] * 6 + [1]), ("rotvec", [0] * 6)]
)
def test_a_model_that_neither_moves_nor_turns_stands_still(
    rotation: Rotation, step: list[float]
) -> None:
    assert "stands_still" in found(rotation, step)
