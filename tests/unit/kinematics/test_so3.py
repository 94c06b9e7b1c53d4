"""Rotations and poses: conventions, conversions there and back, rates of a rotation vector."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.kinematics.so3 import (
    Pose,
    angle_between,
    cross3,
    exp3,
    interpolate,
    log3,
    norm3,
    orthonormal,
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rpy,
    spatial_rates,
)

ROTATION_ATOL = 1e-12
LOG_ATOL_RAD = 1e-7  # near a half turn the logarithm loses half of its digits
RATE_ATOL = 1e-6  # of finite differences, rad/s
RATE_CHANGE_ATOL = 1e-3  # of second finite differences, rad/s^2

numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@given(vectors)
def test_a_rotation_vector_comes_back_from_its_matrix(rotvec: np.ndarray) -> None:
    rotation = exp3(rotvec)
    np.testing.assert_allclose(exp3(log3(rotation)), rotation, atol=LOG_ATOL_RAD)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    if norm3(rotvec) < math.pi - 1e-3:
        np.testing.assert_allclose(log3(rotation), rotvec, atol=LOG_ATOL_RAD)


@given(vectors)
def test_a_quaternion_comes_back_with_its_real_part_positive(rotvec: np.ndarray) -> None:
    quat = quat_from_rotation(exp3(rotvec))
    assert quat[3] >= 0
    assert norm3(quat) == pytest.approx(1.0, abs=ROTATION_ATOL)
    np.testing.assert_allclose(rotation_from_quat(quat), exp3(rotvec), atol=ROTATION_ATOL)
    np.testing.assert_allclose(rotation_from_quat(-quat), exp3(rotvec), atol=ROTATION_ATOL)


def test_a_quaternion_is_stored_x_y_z_w() -> None:
    np.testing.assert_allclose(
        quat_from_rotation(exp3(np.array([0.0, 0.0, math.pi / 2]))),
        [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)],
        atol=ROTATION_ATOL,
    )


@given(vectors)
def test_rpy_turns_about_the_fixed_axes_x_then_y_then_z(rpy: np.ndarray) -> None:
    x, y, z = np.eye(3)
    by_hand = exp3(rpy[2] * z) @ exp3(rpy[1] * y) @ exp3(rpy[0] * x)
    np.testing.assert_allclose(rotation_from_rpy(rpy), by_hand, atol=ROTATION_ATOL)


@given(vectors, vectors, vectors, st.sampled_from([0.0, 1e-5, 9.9e-4, 1.1e-3, 0.1, 1.0, 3.0]))
def test_body_rates_are_those_of_finite_differences(
    direction: np.ndarray, rate: np.ndarray, change: np.ndarray, angle: float
) -> None:
    length = norm3(direction)
    rotvec = direction * (angle / length) if length > 1e-3 else np.zeros(3)
    step_s = 1e-4

    def rotation(t: float) -> np.ndarray:
        return exp3(rotvec + rate * t + 0.5 * change * t * t)

    def spin(t: float) -> np.ndarray:
        forth, back = rotation(t + step_s / 2), rotation(t - step_s / 2)
        return rotation(t).T @ (log3(forth @ back.T) / step_s)

    velocity, acceleration = spatial_rates(rotvec, rate, change, side=-1.0)
    np.testing.assert_allclose(velocity, spin(0.0), atol=RATE_ATOL)
    numerical = (spin(step_s) - spin(-step_s)) / (2 * step_s)
    np.testing.assert_allclose(acceleration, numerical, atol=RATE_CHANGE_ATOL)


def test_body_rates_do_not_jump_where_the_series_takes_over() -> None:
    direction, rate = np.array([0.6, 0.0, 0.8]), np.array([1.0, -2.0, 0.5])
    change = np.array([3.0, 1.0, -4.0])
    below = spatial_rates(direction * 0.999e-3, rate, change, side=-1.0)
    above = spatial_rates(direction * 1.001e-3, rate, change, side=-1.0)
    np.testing.assert_allclose(below[0], above[0], atol=1e-5)
    np.testing.assert_allclose(below[1], above[1], atol=1e-5)


def test_orthonormal_repairs_a_product_of_many_rotations() -> None:
    turn = exp3(np.array([0.3, -0.2, 0.1]))
    product = np.eye(3)
    for _ in range(20_000):
        product = turn @ product
    repaired = orthonormal(product)
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-15)
    assert angle_between(repaired, product) < 1e-10


@given(vectors, vectors, st.floats(0.0, 1.0))
def test_between_goes_straight_from_start_to_end(
    way: np.ndarray, turn: np.ndarray, share: float
) -> None:
    turn *= 0.5
    start = Pose(np.array([0.4, 0.1, 0.3]), exp3(np.array([1.0, 0.5, -0.3])))
    end = Pose(start.position_m + way, exp3(turn) @ start.rotation)
    pose = interpolate(start, end, share)
    np.testing.assert_allclose(pose.position_m, start.position_m + share * way, atol=1e-12)
    assert angle_between(start.rotation, pose.rotation) == pytest.approx(
        share * norm3(turn), abs=LOG_ATOL_RAD
    )
    assert angle_between(pose.rotation, end.rotation) == pytest.approx(
        (1 - share) * norm3(turn), abs=LOG_ATOL_RAD
    )


def test_a_cross_product_is_right_handed() -> None:
    x, y, z = np.eye(3)
    np.testing.assert_array_equal(cross3(x, y), z)
    np.testing.assert_array_equal(cross3(y, z), x)
    np.testing.assert_array_equal(cross3(z, x), y)
