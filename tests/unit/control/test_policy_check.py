"""What a model's numbers ask of an arm: joints taken for poses, and axes that five joints lack."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vla_zenoh.control.policy_check import beyond_joints, immovable_axes, joints_as_pose
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import load_profile

LIMITS = load_profile("panda_sim").limits
SIX_JOINTS_RAD = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
TURN = np.zeros(6, bool)
POSE = [0.45, 0.0, 0.3, 3.1, 0.0, 0.0]


def absolute(rotation: str = "rotvec") -> ActionSpec:
    return ActionSpec(kind="absolute", rotation=rotation, gripper="none", horizon=2, dt_s=0.1)  # pyright: ignore


def deltas(**parts: object) -> ActionSpec:
    return ActionSpec(rotation="rotvec", gripper="none", horizon=2, dt_s=0.1, **parts)  # pyright: ignore


def test_joint_positions_declared_as_poses_are_an_error_that_says_why() -> None:
    steps = np.array([SIX_JOINTS_RAD, SIX_JOINTS_RAD + 0.02], np.float32)
    (finding,) = joints_as_pose(absolute(), steps, SIX_JOINTS_RAD, TURN, LIMITS)
    assert finding.level == "error"
    assert "these are joint positions" in finding.why
    assert "within 0.00 of the joints in rad" in finding.why


def test_joint_positions_far_from_the_arm_s_are_found_by_the_workspace() -> None:
    steps = np.full((2, 6), -2.0, np.float32)
    (finding,) = joints_as_pose(absolute(), steps, SIX_JOINTS_RAD, TURN, LIMITS)
    assert "or more outside the workspace" in finding.why


def test_poses_are_no_joint_positions() -> None:
    steps = np.array([POSE, POSE], np.float32)
    assert joints_as_pose(absolute(), steps, SIX_JOINTS_RAD, TURN, LIMITS) == []


def test_poses_of_an_arm_with_another_number_of_joints_are_not_looked_at() -> None:
    steps = np.array([POSE, POSE], np.float32)
    assert joints_as_pose(absolute(), steps, np.zeros(7), np.zeros(7, bool), LIMITS) == []


def jacobian_without(*axes: int) -> np.ndarray:
    """Of an arm whose joints each move one axis, all but these."""
    return np.delete(np.eye(6), axes, axis=1)


@pytest.mark.parametrize(("missing", "name"), [(1, "y"), (3, "roll"), (5, "yaw")])
def test_an_axis_that_no_joint_moves_is_named(missing: int, name: str) -> None:
    assert immovable_axes(jacobian_without(missing)) == (name,)


def test_six_joints_move_every_axis() -> None:
    assert immovable_axes(jacobian_without()) == ()


def test_a_chunk_that_asks_five_joints_for_the_sixth_axis_is_named_with_its_amount() -> None:
    steps = np.zeros((2, 6), np.float32)
    steps[:, 5] = 0.05
    assert beyond_joints(deltas(), steps, jacobian_without(5), np.eye(3)) == ["yaw (+0.1 rad)"]


@pytest.mark.parametrize("signs", [(1, 1), (-1, -1), (1, -1)])
def test_either_sign_of_a_quaternion_asks_for_the_same_turn(signs: tuple[int, int]) -> None:
    spec = ActionSpec(rotation="quaternion", gripper="none", horizon=2, dt_s=0.1)
    turn = np.array([0.0, 0.0, math.sin(0.05), math.cos(0.05)])
    steps = np.array([[0.0, 0.0, 0.0, *(sign * turn)] for sign in signs], np.float32)
    assert beyond_joints(spec, steps, jacobian_without(5), np.eye(3)) == ["yaw (+0.2 rad)"]


def test_a_delta_in_the_frame_of_the_tcp_is_judged_in_base_axes() -> None:
    steps = np.zeros((2, 6), np.float32)
    steps[:, 0] = 0.01
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # TCP's x is base's y
    found = beyond_joints(deltas(frame="tcp"), steps, jacobian_without(1), quarter)
    assert found == ["y (+0.02 m)"]


def test_what_five_joints_can_do_is_not_in_the_way() -> None:
    steps = np.zeros((2, 6), np.float32)
    steps[:, 2] = 0.02
    steps[:, 5] = 0.001  # noise of a model
    assert beyond_joints(deltas(), steps, jacobian_without(5), np.eye(3)) == []
