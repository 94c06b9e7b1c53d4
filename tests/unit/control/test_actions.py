"""What the numbers of a step mean: frames, rotation forms, kinds, units, gripper meanings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.control.actions import step_pose, step_width
from vla_zenoh.control.plan_timeline import Goal
from vla_zenoh.control.policy_check import chunk_errors, validate_steps
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import Pose, angle_between, exp3, log3, quat_from_rotation
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import Limits

ATOL = 1e-9
MAX_WIDTH_M = 0.08
BEFORE = Pose(np.array([0.45, -0.1, 0.3]), exp3(np.array([2.8, 0.3, -0.5])))

small = st.tuples(*[st.floats(-0.2, 0.2)] * 3).map(np.array)


def spec(**fields: object) -> ActionSpec:
    return ActionSpec(**{"horizon": 8, "dt_s": 0.1, "gripper": "none", **fields})  # pyright: ignore


def assert_same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.position_m, b.position_m, atol=ATOL)
    assert angle_between(a.rotation, b.rotation) < ATOL


@given(small, small)
def test_base_and_tcp_frame_say_the_same_motion_in_their_own_axes(
    way: np.ndarray, turn: np.ndarray
) -> None:
    base = step_pose(spec(rotation="rotvec"), np.concatenate([way, turn]), BEFORE)
    into_tcp = BEFORE.rotation.T
    tcp_step = np.concatenate([into_tcp @ way, into_tcp @ turn])
    assert_same(base, step_pose(spec(rotation="rotvec", frame="tcp"), tcp_step, BEFORE))


@given(small, small)
def test_all_rotation_forms_say_the_same_rotation(way: np.ndarray, rpy: np.ndarray) -> None:
    by_rpy = step_pose(spec(rotation="rpy"), np.concatenate([way, rpy]), BEFORE)
    turn = by_rpy.rotation @ BEFORE.rotation.T
    for rotation, numbers in (("rotvec", log3(turn)), ("quaternion", quat_from_rotation(turn))):
        step = np.concatenate([way, numbers])
        assert_same(by_rpy, step_pose(spec(rotation=rotation), step, BEFORE))


@given(small, small)
def test_a_delta_undone_by_the_absolute_pose_before_it(way: np.ndarray, turn: np.ndarray) -> None:
    there = step_pose(spec(rotation="rotvec"), np.concatenate([way, turn]), BEFORE)
    back = np.concatenate([BEFORE.position_m, log3(BEFORE.rotation)])
    assert_same(BEFORE, step_pose(spec(rotation="rotvec", kind="absolute"), back, there))


@given(st.lists(st.tuples(small, small), min_size=1, max_size=12), st.data())
def test_deltas_composed_in_any_split_of_chunks_give_the_same_pose(
    steps: list[tuple[np.ndarray, np.ndarray]], data: st.DataObject
) -> None:
    action = spec(rotation="rotvec")
    numbers = [np.concatenate(step) for step in steps]
    whole = BEFORE
    for step in numbers:
        whole = step_pose(action, step, whole)
    cut = data.draw(st.integers(0, len(numbers)))
    first = BEFORE
    for step in numbers[:cut]:
        first = step_pose(action, step, first)
    for step in numbers[cut:]:
        first = step_pose(action, step, first)
    assert_same(whole, first)
    np.testing.assert_allclose(
        whole.position_m, BEFORE.position_m + sum(step[0] for step in steps), atol=ATOL
    )


@given(small, small, st.integers(1, 20))
def test_a_step_cut_into_equal_parts_gives_the_same_pose(
    way: np.ndarray, turn: np.ndarray, parts: int
) -> None:
    action = spec(rotation="rotvec")
    step = np.concatenate([way, turn])
    pose = BEFORE
    for _ in range(parts):
        pose = step_pose(action, step / parts, pose)
    assert_same(step_pose(action, step, BEFORE), pose)


def test_the_position_scale_is_metres_of_one_unit() -> None:
    action = spec(position_scale_m=0.001)
    pose = step_pose(action, np.array([10.0, 0, 0, 0, 0, 0]), BEFORE)
    np.testing.assert_allclose(pose.position_m - BEFORE.position_m, [0.01, 0, 0], atol=ATOL)


def test_a_rotation_that_is_no_unit_quaternion_is_refused() -> None:
    with pytest.raises(RecordError, match=r"rotation of the action has norm 0"):
        step_pose(spec(rotation="quaternion"), np.zeros(7), BEFORE)


@pytest.mark.parametrize(
    ("fields", "value", "before_m", "wanted_m"),
    [
        ({"gripper": "none"}, 0.3, 0.05, None),
        ({"gripper": "delta_m"}, -0.02, 0.05, 0.03),
        ({"gripper": "delta_m"}, -0.05, 0.03, 0.0),
        ({"gripper": "delta_m"}, 0.05, 0.05, 0.08),
        ({"gripper": "absolute_m"}, 0.04, 0.01, 0.04),
        ({"gripper": "absolute_m"}, 0.1, 0.01, 0.08),
        ({"gripper": "open_fraction"}, 0.25, 0.0, 0.02),
        ({"gripper": "open_fraction"}, 1.1, 0.0, 0.08),
        ({"gripper": "open_fraction"}, -0.1, 0.08, 0.0),
        ({"gripper": "open_fraction", "gripper_open_is_high": False}, 0.25, 0.0, 0.06),
        ({"gripper": "binary"}, 0.7, 0.0, 0.08),
        ({"gripper": "binary"}, 0.3, 0.08, 0.0),
        ({"gripper": "binary", "gripper_open_is_high": False}, 0.7, 0.08, 0.0),
        ({"gripper": "binary", "gripper_threshold": 0.0}, 0.1, 0.0, 0.08),
        ({"gripper": "binary", "gripper_threshold": 0.0}, -1.0, 0.08, 0.0),
        ({"gripper": "binary", "gripper_threshold": 0.0}, 0.0, 0.08, 0.0),
        ({"gripper": "binary", "gripper_open_is_high": False}, 0.5, 0.0, 0.08),
    ],
)
def test_a_gripper_number_means_what_the_spec_says(
    fields: dict[str, object], value: float, before_m: float, wanted_m: float | None
) -> None:
    step = np.array([0, 0, 0, 0, 0, 0, value])
    assert step_width(spec(**fields), step, before_m, MAX_WIDTH_M) == pytest.approx(wanted_m)


@pytest.mark.parametrize(
    ("gripper", "value"),
    [("delta_m", 1.0), ("delta_m", -0.5), ("absolute_m", 1.0), ("absolute_m", -1.0)]
    + [("open_fraction", 1.5), ("open_fraction", -1.0)],
)
def test_a_gripper_number_that_its_meaning_cannot_have_is_refused_by_name(
    gripper: str, value: float
) -> None:
    with pytest.raises(RecordError, match=f"gripper {gripper}"):
        step_width(spec(gripper=gripper), np.array([0, 0, 0, 0, 0, 0, value]), 0.04, MAX_WIDTH_M)


# -- 6D rotations ---------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["delta", "absolute"])
def test_a_6d_rotation_is_the_same_step_as_a_quaternion(kind: Any) -> None:
    turn = exp3(np.array([0.3, -0.2, 0.1]))
    columns = [*turn.T[0], *turn.T[1]]
    poses = [
        step_pose(spec(kind=kind, rotation=rotation), np.array([0.4, 0, 0.3, *numbers]), BEFORE)
        for rotation, numbers in (
            ("quaternion", quat_from_rotation(turn)),
            ("rotation_6d", columns),
            ("rotation_6d", [2.0 * value for value in columns]),
        )
    ]
    for pose in poses[1:]:
        np.testing.assert_allclose(pose.position_m, poses[0].position_m, atol=1e-12)
        np.testing.assert_allclose(pose.rotation, poses[0].rotation, atol=1e-9)


def test_6d_rotations_are_checked_and_bounded_as_quaternions_are() -> None:
    action = spec(rotation="rotation_6d", gripper="none")
    limits = Limits()

    def named(numbers: list[float]) -> list[str]:
        steps = np.array([[0.0, 0, 0, *numbers]], np.float32)
        return [found.name for found in chunk_errors(action, steps, limits, MAX_WIDTH_M)]

    assert named([1, 0, 0, 0, 1, 0]) == []
    assert named([0, 0, 0, 0, 0, 0]) == ["rotation_6d"]
    assert named([1, 0, 0, 2, 0, 0]) == ["rotation_6d"]
    assert named([1, 0, 0, 0, -1, 0]) == ["rotation_units"]
    start = Goal(BEFORE, 0.04)
    for numbers, reason in (([0.0] * 6, "meaning"), ([1, 0, 0, 0, -1, 0], "step_rad")):
        steps = np.array([[0.0, 0, 0, *numbers]])
        refused = validate_steps(action, steps, start, limits, MAX_WIDTH_M, np.zeros(0, bool))
        assert refused is not None
        assert refused[0] == reason
    assert (
        validate_steps(
            action,
            np.array([[0.0, 0, 0, 1, 0, 0, 0, 1, 0]]),
            start,
            limits,
            MAX_WIDTH_M,
            np.zeros(0, bool),
        )
        is None
    )
