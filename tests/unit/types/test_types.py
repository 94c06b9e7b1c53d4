"""A record that exists is valid, and stays as it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from vla_zenoh.errors import RecordError
from vla_zenoh.types import (
    QUATERNION_NORM_TOLERANCE,
    ActionChunk,
    Event,
    GripperCommand,
    GripperState,
    Header,
    Image,
    JointCommand,
    JointState,
    NodeStatus,
    PoseCommand,
    PoseState,
    SceneState,
    Task,
    stream,
)
from vla_zenoh.types.arrays import MAX_VECTOR
from vla_zenoh.types.form import shown

UNIT = np.array([0.0, 0.0, 0.0, 1.0])
QUATERNION_TOLERANCE = 1e-15


def chunk(steps: Any, **changes: Any) -> ActionChunk:
    fields = dict.fromkeys(
        (
            "episode",
            "observation_stamp_ns",
            "observation_seq",
            "valid_until_ns",
            "observed_ns",
            "inference_start_ns",
            "inference_end_ns",
        ),
        1,
    )
    return ActionChunk(worker="w", spec_hash="h", steps=steps, **(fields | changes))


def test_a_record_keeps_its_own_copy_of_an_array() -> None:
    mine = np.zeros(3)
    pose = PoseState(mine, UNIT, np.zeros(6))
    mine[0] = 5.0
    assert pose.position_m.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="read-only"):
        pose.position_m[0] = 1.0


def test_a_record_cannot_be_changed() -> None:
    header = Header(1, 2, "a")
    with pytest.raises(dataclasses.FrozenInstanceError):
        header.seq = 3  # pyright: ignore[reportAttributeAccessIssue]


def test_a_quaternion_that_is_nearly_unit_is_made_so() -> None:
    pose = PoseState(np.zeros(3), UNIT * (1 + 0.9 * QUATERNION_NORM_TOLERANCE), np.zeros(6))
    assert abs(np.linalg.norm(pose.quat_xyzw) - 1) < QUATERNION_TOLERANCE
    with pytest.raises(RecordError, match=r"quat_xyzw has norm 1\.0011"):
        PoseState(np.zeros(3), UNIT * (1 + 1.1 * QUATERNION_NORM_TOLERANCE), np.zeros(6))


def test_an_image_does_not_lock_the_array_it_was_made_of() -> None:
    mine = np.zeros((2, 3, 3), np.uint8)
    image = Image(mine)
    assert np.shares_memory(image.rgb, mine)
    assert not image.rgb.flags.writeable
    mine[0, 0] = 1


def test_an_image_is_laid_out_row_by_row() -> None:
    assert Image(np.zeros((4, 6, 3), np.uint8)[:, ::2]).rgb.flags.c_contiguous


@pytest.mark.parametrize(
    ("rgb", "said"),
    [
        (np.zeros((2, 2, 3)), "must be a uint8 array"),
        ([[[0, 0, 0]]], "must be a uint8 array"),
        (np.zeros((2, 2), np.uint8), r"shape \(2, 2\), wanted \(H, W, 3\)"),
        (np.zeros((2, 2, 4), np.uint8), r"shape \(2, 2, 4\)"),
        (np.zeros((0, 2, 3), np.uint8), r"shape \(0, 2, 3\)"),
    ],
)
def test_what_is_no_image_is_refused(rgb: Any, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        Image(rgb)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([1, 2], r"position_m is \[1, 2\], allowed: a list of 3, each a number from"),
        ([[1, 2, 3]], r"position_m is \[\[1, 2, 3\]\], allowed: a list of 3"),
        (5, "position_m is 5, allowed: a list of 3"),
        ([1, 2, np.nan], r"position_m\[2\] is nan, allowed: a number from -1e6 to 1e6"),
        ([1, 2, -np.inf], r"position_m\[2\] is -inf"),
        ([1, 2, 1.1e6], r"position_m\[2\] is 1100000.0, allowed: a number from -1e6 to"),
        ([1, 2, True], r"position_m\[2\] is True"),
        ([True, False, True], r"position_m\[0\] is True"),
        (np.array([True, False, True]), r"position_m\[0\] is True"),
        (["1", "2", "3"], r"position_m\[0\] is '1'"),
        ([1, 2, None], r"position_m\[2\] is None"),
        ([1, 2, 3j], r"position_m is \[1, 2, 3j\]"),
        ([1, [2], 3], r"position_m\[1\] is \[2\]"),
        (np.array(["2020"] * 3, "M8[Y]"), r"position_m\[0\] is"),
        ("123", "position_m is '123'"),
        ([10**400, 1, 1], "position_m is"),
        (None, "position_m is None"),
    ],
)
def test_what_is_no_vector_is_refused(value: Any, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        PoseState(value, UNIT, np.zeros(6))


def test_a_vector_has_a_bound_even_where_any_size_will_do() -> None:
    assert SceneState("table", np.zeros(MAX_VECTOR)).qpos.shape == (MAX_VECTOR,)
    with pytest.raises(RecordError, match="allowed: a list of 0 to 10000, each a finite number"):
        SceneState("table", np.zeros(MAX_VECTOR + 1))


@pytest.mark.parametrize(
    "value", [True, np.True_, "1", None, float("nan"), float("inf"), 10**400, [1], 1j, -0.1, 1.1]
)
def test_what_is_no_number_within_bounds_is_refused(value: Any) -> None:
    with pytest.raises(RecordError, match=r"^width_m is .* allowed: a number from 0 to 1"):
        GripperCommand(value, 0.1, 1.0)


@pytest.mark.parametrize("value", [True, np.True_, "1", None, 1.0, np.float64(1), -1, 2**63, 2**64])
def test_what_is_no_whole_number_within_bounds_is_refused(value: Any) -> None:
    with pytest.raises(RecordError, match=r"^seq is .* allowed: a whole number from 0 to "):
        Header(1, value, "a")


def test_numbers_of_numpy_become_plain_ones() -> None:
    task = Task(np.int64(1), np.True_, "go", "w", np.float32(5))  # pyright: ignore[reportArgumentType]
    assert [type(v) for v in (task.episode, task.active, task.rate_hz)] == [int, bool, float]
    state = GripperState(np.float64(0.04), np.False_, np.True_)  # pyright: ignore[reportArgumentType]
    assert [type(v) for v in (state.width_m, state.moving)] == [float, bool]
    assert type(GripperCommand(np.float32(0), 1, 1).width_m) is float  # pyright: ignore[reportArgumentType]


def test_text_that_cannot_travel_is_refused() -> None:
    with pytest.raises(RecordError, match=r"prompt is .* surrogates not allowed"):
        Task(1, True, "\ud83e", "w", 5.0)
    assert Task(1, True, "\U0001f9f1 é", "w", 5.0).prompt == "\U0001f9f1 é"


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((), "allowed: at least one name, none of them twice"),
        (("a", "a"), "allowed: at least one name, none of them twice"),
        ("ab", "names is 'ab', allowed: a list of 0 to 1024, each text of at most 128"),
        (None, "names is None"),
        ((1, 2), r"names\[0\] is 1, allowed: text of at most 128 characters"),
        (("x" * 200,), r"names\[0\] is 'xxx.* allowed: text of at most 128 characters"),
    ],
)
def test_joints_need_names_that_differ(names: Any, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        JointState(names, np.zeros(2), np.zeros(2), np.zeros(2))
    with pytest.raises(RecordError, match=said):
        JointCommand(names, np.zeros(2), np.zeros(2), np.zeros(2), "active")


def test_every_joint_needs_every_value() -> None:
    with pytest.raises(
        RecordError, match="velocity_rad_s has 2 numbers, allowed: one for each of the 1 names"
    ):
        JointState(("a",), np.zeros(1), np.zeros(2), np.zeros(1))
    with pytest.raises(
        RecordError, match="reference_rad has 2 numbers, allowed: one for each of the 1"
    ):
        JointState(("a",), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(2))
    with pytest.raises(
        RecordError, match="position_rad has 2 numbers, allowed: one for each of the 1"
    ):
        JointCommand(("a",), np.zeros(2), np.zeros(1), np.zeros(1), "active")


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (np.zeros(7), r"steps\[0\] is 0.0, allowed: a list of 1 to 100, each a number"),
        (np.zeros((0, 7)), r"steps is \[\], allowed: a list of 1 to 1000"),
        (np.zeros((2, 0)), r"steps\[0\] is \[\]"),
        ([[1.0, True]], r"steps\[0\]\[1\] is True"),
        ([["1", "2"]], r"steps\[0\]\[0\] is '1'"),
        ([[1], [1, 2]], "steps has rows of several lengths"),
        (np.full((1, 7), np.nan), r"steps\[0\]\[0\] is nan"),
        ([[1e300]], r"steps\[0\]\[0\] is 1e\+300, allowed: a number from"),
        (np.zeros((1000, 1000)), r"steps\[0\] is .* allowed: a list of 1 to 100"),
    ],
)
def test_steps_that_mean_nothing_are_refused(steps: Any, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        chunk(steps)


def test_steps_may_be_lists_and_become_read_only_floats() -> None:
    steps = chunk([[1, 2.5], [3, 4]]).steps
    assert steps.dtype == np.float32
    assert not steps.flags.writeable


def test_done_is_a_truth_value() -> None:
    assert chunk([[1.0]], done=np.True_).done is True
    with pytest.raises(RecordError, match="done is 1, allowed: true or false"):
        chunk([[1.0]], done=1)


def test_a_command_names_its_cause_or_none() -> None:
    with pytest.raises(RecordError, match="cause lacks worker"):
        PoseCommand(
            np.zeros(3),
            UNIT,
            np.zeros(6),
            np.zeros(6),
            np.zeros(3),
            UNIT,
            "active",
            {},  # type: ignore[arg-type]
        )
    zero = np.zeros(1)
    with pytest.raises(RecordError, match="cause is 'me', allowed: null or a Cause"):
        JointCommand(("a",), zero, zero, zero, "active", "me")  # type: ignore[arg-type]


def test_a_reference_pose_is_whole_or_absent() -> None:
    with pytest.raises(RecordError, match="needs both position and quaternion"):
        PoseState(np.zeros(3), UNIT, np.zeros(6), reference_quat_xyzw=UNIT)


def test_status_keeps_its_own_copy_of_its_maps() -> None:
    counters = {"a": 1}
    status = NodeStatus("n", "s", "h", 1, 1, counters=counters, detail={"list": (1, 2)})
    counters["b"] = 2
    assert status.counters == {"a": 1}
    assert status.detail == {"list": [1, 2]}


@pytest.mark.parametrize(
    ("detail", "said"),
    [
        ({1: 2}, "a name in detail is wrong: Expected `str`, got `int`"),
        ({"x" * 300: 1}, "a name in detail is wrong: .* at most 256 characters"),
        ({"a": object()}, ".object has no msgpack form"),
        ({"a": [[[[1]]]]}, "detail.a is .* nested 3 deep at most"),
        ({"a": 2**64}, "detail is {'a': 18446744073709551616}"),
        ({"a": 2**63}, "detail.a is 9223372036854775808"),
        ({"a": "x" * 70_000}, "detail.a is 'xxx"),
        ({"a": list(range(2000))}, "detail.a is .0, 1"),
    ],
)
def test_detail_that_could_not_be_shown_is_refused(detail: Any, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        NodeStatus("n", "s", "h", 1, 1, detail=detail)


class Unprintable:
    def __repr__(self) -> str:
        raise ValueError("no")


def deep() -> list[Any]:
    inner: list[Any] = []
    for _ in range(50_000):
        inner = [inner]
    return inner


@pytest.mark.parametrize(
    "make",
    [
        Unprintable,
        deep,
        lambda: "x" * 10**6,
        lambda: [["x" * 1000] * 1000] * 9,
        lambda: {1: deep()},
    ],
    ids=["unprintable", "deep", "long", "wide", "deep map"],
)
def test_an_error_can_always_be_written(make: Callable[[], Any]) -> None:
    assert len(shown(make())) < 400


def test_an_event_is_of_a_known_kind_and_level() -> None:
    for level in stream.EVENT_LEVELS:
        for kind in stream.EVENT_KINDS:
            assert Event(level, kind, "x").level == level
    with pytest.raises(RecordError, match="level is 'debug', allowed: error or info or warning"):
        Event("debug", "notice", "x")
