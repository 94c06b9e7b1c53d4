"""Rotations and openings as numbers, and back: inverse in every form, and without a jump."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.so3 import angle_between, exp3, rotation_from_quat, rotation_from_rpy
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.inference import rest_of
from vla_zenoh.policy.meaning import (
    IDENTITY,
    ROTATION_FORMS,
    GripperScale,
    reference,
    toward,
    unturned,
)

ATOL = 1e-6
"""Of rotation matrices; extrinsic angles lose digits near a pitch of 90 degrees."""
FORMS = tuple(ROTATION_FORMS)
DOWN = (1.0, 0.0, 0.0, 0.0)
NOISE_RAD = 1e-4


def unit_quaternions() -> st.SearchStrategy[list[float]]:
    numbers = st.lists(st.floats(-1, 1), min_size=4, max_size=4)
    long = numbers.filter(lambda each: math.hypot(*each) > 0.1)
    return long.map(lambda each: [value / math.hypot(*each) for value in each])


@given(unit_quaternions(), unit_quaternions(), st.sampled_from(FORMS))
@example([0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)], list(DOWN), "rpy")
@example([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)], list(IDENTITY), "rpy")
@example([1.0, 0.0, 0.0, 0.0], list(IDENTITY), "rotvec")
def test_decode_is_the_inverse_of_encode(quat: list[float], near: list[float], form: str) -> None:
    numbers = ROTATION_FORMS[form].encode(quat, reference(near))
    assert len(numbers) == ROTATION_FORMS[form].size
    same = rotation_from_quat(np.array(ROTATION_FORMS[form].decode(numbers)))
    np.testing.assert_allclose(same, rotation_from_quat(np.array(quat)), atol=ATOL)


@given(unit_quaternions())
def test_the_forms_are_those_of_kinematics(quat: list[float]) -> None:
    wanted = rotation_from_quat(np.array(quat))
    told = {form: ROTATION_FORMS[form].encode(quat, IDENTITY) for form in FORMS}
    np.testing.assert_allclose(rotation_from_rpy(np.array(told["rpy"])), wanted, atol=ATOL)
    np.testing.assert_allclose(exp3(np.array(told["rotvec"])), wanted, atol=ATOL)
    np.testing.assert_allclose(told["rotation_6d"], wanted.T[:2].ravel(), atol=ATOL)
    np.testing.assert_allclose(told["rotation_6d_rows"], wanted[:2].ravel(), atol=ATOL)
    assert told["quat_wxyz"][0] >= 0
    assert max(map(abs, told["rpy"])) <= math.pi + ATOL


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("yaw_deg", [0, 45, 90, 135, 180, -90])
def test_no_number_jumps_with_the_tool_straight_down(form: str, yaw_deg: int) -> None:
    """The commonest pose there is: half a turn, where the usual forms have their cut."""
    random = np.random.default_rng(yaw_deg % 360)
    home = rotation_from_rpy(np.array([math.pi, 0.0, math.radians(yaw_deg)]))
    near = reference(quat_of(home))
    wanted = ROTATION_FORMS[form].encode(near, near)
    for _ in range(200):
        noisy = home @ exp3(random.normal(0, NOISE_RAD, 3))
        # A robot tells either sign.
        quat = random.choice([-1.0, 1.0]) * np.array(quat_of(noisy))
        numbers = ROTATION_FORMS[form].encode(quat, near)
        np.testing.assert_allclose(numbers, wanted, atol=10 * NOISE_RAD)


def quat_of(rotation: np.ndarray) -> list[float]:
    turns = [*rotation.T[0], *rotation.T[1]]
    return ROTATION_FORMS["rotation_6d"].decode(turns)


@given(
    unit_quaternions(),
    unit_quaternions(),
    st.sampled_from([form for form in FORMS if form != "rpy"]),
)
def test_numbers_are_continuous_less_than_half_a_turn_from_their_reference(
    quat: list[float], near: list[float], form: str
) -> None:
    near = list(reference(near))
    signed = toward(quat, near)
    assume(sum(a * b for a, b in zip(signed, near, strict=True)) > 0.05)
    there = np.array(toward(near, near))
    # Straight on from the reference, a thousandth of the way at a time.
    way = [there + share * (np.array(signed) - there) for share in np.linspace(0, 1, 400)]
    told = [ROTATION_FORMS[form].encode(q / np.linalg.norm(q), near) for q in way]
    assert np.abs(np.diff(told, axis=0)).max() < 0.5


@given(st.lists(st.floats(-1e-9, 1e-9), min_size=4, max_size=4), st.sampled_from(range(6)))
def test_rounding_does_not_change_a_reference(noise: list[float], which: int) -> None:
    half = math.sqrt(0.5)
    quat = [DOWN, (0, 1, 0, 0), (0, 0, 1, 0), IDENTITY, (half, 0, 0, half), (0.6, 0.8, 0, 0)][which]
    for sign in (1.0, -1.0):
        found = reference([sign * a + b for a, b in zip(quat, noise, strict=True)])
        np.testing.assert_allclose(found, quat, atol=1e-8)


@given(
    st.sampled_from(["rpy", "rotvec", "quaternion"]),
    unit_quaternions(),
    st.floats(0, math.pi - 0.2),
    st.floats(0.05, 0.95),
)
def test_absolute_rotations_are_interpolated_on_the_shortest_turn(
    form: Any, quat: list[float], turn_rad: float, share: float
) -> None:
    spec = ActionSpec(horizon=4, dt_s=0.1, kind="absolute", rotation=form, gripper="none")
    first = rotation_from_quat(np.array(quat))
    second = first @ exp3(np.array([turn_rad, 0.0, 0.0]))
    rows = [
        [0.0, 0.0, 0.0, *ROTATION_FORMS[form].encode(quat_of(each), IDENTITY)]
        for each in (first, first, second)
    ]
    left = rest_of(spec, np.array(rows, np.float32), 1.0 + share)
    found = rotation_from_quat(np.array(ROTATION_FORMS[form].decode(left[0, 3:].tolist())))
    assert angle_between(first, found) == pytest.approx(share * turn_rad, abs=3e-3)
    assert angle_between(found, second) == pytest.approx((1 - share) * turn_rad, abs=3e-3)


@pytest.mark.parametrize(
    ("form", "numbers", "why"),
    [
        ("quat_xyzw", [0.1, 0, 0, 0], "a quaternion of norm 0.1; wanted 1"),
        ("quat_wxyz", [math.nan, 0, 0, 1], "a quaternion of norm nan"),
        ("rotation_6d", [0.0] * 6, "6D rotation whose columns have the lengths 0"),
        ("rotation_6d", [1, 0, 0, 2, 0, 0], "lengths 1 and 0 across"),
        ("rotation_6d_rows", [1, 0, 0, math.nan, 0, 0], "6D rotation"),
    ],
)
def test_numbers_that_are_no_rotation_are_named(form: str, numbers: list[float], why: str) -> None:
    with pytest.raises(SpecError, match=why):
        ROTATION_FORMS[form].decode(numbers)


def test_a_6d_rotation_of_a_network_is_made_orthonormal() -> None:
    """Zhou et al., equation 15: the first column keeps its direction."""
    found = ROTATION_FORMS["rotation_6d"].decode([2.0, 0, 0, 0.7, 0.5, 0.0])
    np.testing.assert_allclose(found, IDENTITY, atol=ATOL)


def test_no_turn_in_every_form() -> None:
    for form in FORMS:
        np.testing.assert_allclose(ROTATION_FORMS[form].decode(unturned(form)), IDENTITY)


@given(st.floats(-200, 200), st.floats(-200, 200), st.floats(0, 1))
def test_a_gripper_s_number_is_read_back(shut: float, opened: float, share: float) -> None:
    assume(abs(shut - opened) > 1e-3)
    scale = GripperScale(shut, opened)
    assert scale.decode(scale.encode(share)) == pytest.approx(share, abs=1e-9)
