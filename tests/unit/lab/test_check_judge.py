"""What the answers of a model have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vla_zenoh.control.policy_check import Finding
from vla_zenoh.kinematics.so3 import quat_from_rotation, rotation_from_quat, rotation_from_rpy
from vla_zenoh.lab.check import judge
from vla_zenoh.lab.check.examples import ExampleStyle, chart, example_styles
from vla_zenoh.policy import ActionSpec, Rotation
from vla_zenoh.policy.meaning import ROTATION_FORMS

STEP = 0.02


def found(rotation: Rotation, step: list[float]) -> set[str]:
    action = ActionSpec(horizon=1, dt_s=0.1, rotation=rotation, gripper="none")
    answers = [(ExampleStyle("chart", picture=chart), np.array([step], np.float32))]
    return {finding.name for finding in judge.behaviour(action, answers, {})}


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


WRITTEN: dict[str, tuple[Rotation, str]] = {
    "w first": ("quaternion", "quat_wxyz"),
    "rows": ("rotation_6d", "rotation_6d_rows"),
    "rotvec as rpy": ("rpy", "rotvec"),
    "rpy as rotvec": ("rotvec", "rpy"),
}
TURN = rotation_from_rpy(np.array([0.1, 0.0, 0.05]))


@pytest.mark.parametrize("part", ["", "left"])
@pytest.mark.parametrize("mistake", WRITTEN)
def test_poses_whose_rotation_is_written_in_another_form_are_found(mistake: str, part: str) -> None:
    """A model that hardly turns the tool, from wherever it is."""
    declared, wrote = WRITTEN[mistake]
    own = ActionSpec(horizon=1, dt_s=0.1, rotation=declared, gripper="none", kind="absolute")
    action = ActionSpec.of_parts({"right": own, "left": own}) if part else own

    def answers(form: str, other: str) -> list[tuple[ExampleStyle, Any]]:
        out: list[tuple[ExampleStyle, Any]] = []
        for style in example_styles():
            goal = quat_from_rotation(rotation_from_quat(np.array(style.quat_xyzw)) @ TURN)
            rows = [
                [*style.position_m, *ROTATION_FORMS[each].encode(goal.tolist(), goal.tolist())]
                for each in ((form, other) if part else (other,))
            ]
            out.append((style, np.array([np.concatenate(rows)], np.float32)))
        return out

    def found(form: str, other: str) -> list[Finding]:
        return [
            each
            for each in judge.behaviour(action, answers(form, other), {})
            if each.level == "error"
        ]

    assert found(declared, declared) == []
    (finding,) = found(declared, wrote)
    assert finding.name == declared
    assert f"if its numbers are {wrote}" in finding.why


@pytest.mark.parametrize("rotation", ["quaternion", "rotation_6d", "rpy", "rotvec"])
@pytest.mark.parametrize("yaw_rad", [0.0, 1.5, np.pi])
def test_a_model_that_always_asks_for_one_rotation_is_taken_at_its_word(
    rotation: Rotation, yaw_rad: float
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, rotation=rotation, gripper="none", kind="absolute")
    goal = quat_from_rotation(rotation_from_rpy(np.array([np.pi, 0.0, yaw_rad])))
    numbers = ROTATION_FORMS[rotation].encode(goal.tolist(), goal.tolist())
    row = np.array([[0.4, 0.0, 0.2, *numbers]], np.float32)
    answers = [(style, row) for style in example_styles()]
    assert [each for each in judge.behaviour(action, answers, {}) if each.level == "error"] == []
