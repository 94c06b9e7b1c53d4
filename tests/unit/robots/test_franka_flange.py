"""The profiles of Franka arms against what Franka publishes."""

from __future__ import annotations

import numpy as np
import pytest
from vla_zenoh_franka.arm import flange_pose
from vla_zenoh_franka.check import BY_FCI, Published

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile, load_profile

EXACT_M = EXACT_RAD = 1e-9
FINGERS_M = 0.1034
"""From the flange to between the fingers of a Franka Hand."""


@pytest.fixture(params=["fr3", "panda_fci"])
def profile(request: pytest.FixtureRequest) -> Profile:
    return load_profile(request.param)


@pytest.fixture
def published(profile: Profile) -> Published:
    return BY_FCI[profile.driver_options.fci]


def test_joint_limits_are_within_the_published_ones(profile: Profile, published: Published) -> None:
    for name in ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3"):
        ours = np.array(profile.limits.joint.of(name, 7))
        assert np.all(2 * ours <= getattr(published, name)), name  # a late command doubles them


def test_limits_of_the_tcp_are_within_the_published_ones(
    profile: Profile, published: Published
) -> None:
    translation, rotation = profile.limits.translation, profile.limits.rotation
    ours = (
        (translation.velocity_m_s, translation.acceleration_m_s2, translation.jerk_m_s3),
        (rotation.velocity_rad_s, rotation.acceleration_rad_s2, rotation.jerk_rad_s3),
    )
    # Limits per axis: the norm is at most this factor more.
    for limits, bounds in zip(ours, (published.translation, published.rotation), strict=True):
        assert np.all(2 * np.sqrt(3) * np.array(limits) <= bounds)


def test_joint_ranges_are_within_the_published_ones(profile: Profile, published: Published) -> None:
    kinematics = make_kinematics(profile)
    assert np.all(kinematics.lower_rad >= np.array(published.lower_rad) - EXACT_RAD)
    assert np.all(kinematics.upper_rad <= np.array(published.upper_rad) + EXACT_RAD)


def test_braking_before_an_end_of_a_range_stays_below_the_velocity_allowed_there(
    profile: Profile, published: Published
) -> None:
    margin_rad = profile.limits.reach.joint_margin_rad
    limits, kinematics = profile.limits.joint, make_kinematics(profile)
    spare_rad = margin_rad + np.minimum(
        kinematics.lower_rad - published.lower_rad, published.upper_rad - kinematics.upper_rad
    )
    before_rad = np.linspace(0, 0.5, 501)
    for joint, (offset, deceleration) in enumerate(published.near_end):
        ours = np.sqrt(2 * limits.of("acceleration_rad_s2", 7)[joint] * before_rad)
        ours = np.minimum(ours, limits.of("velocity_rad_s", 7)[joint])
        allowed = np.sqrt(2 * deceleration * (before_rad + spare_rad[joint])) - offset
        assert np.all(ours <= allowed), joint + 1


def test_home_is_inside_them(profile: Profile, published: Published) -> None:
    margin_rad = profile.limits.reach.joint_margin_rad
    assert np.all(np.array(published.lower_rad) + margin_rad < profile.robot.home_rad)
    assert np.all(np.array(published.upper_rad) - margin_rad > profile.robot.home_rad)


def test_the_description_has_the_published_kinematics(profile: Profile) -> None:
    kinematics, random = make_kinematics(profile), np.random.default_rng(1)
    for _ in range(20):
        joints_rad = random.uniform(kinematics.lower_rad, kinematics.upper_rad)
        tcp, flange = kinematics.forward(joints_rad), flange_pose(joints_rad)
        between = flange[:3, :3].T @ (tcp.position_m - flange[:3, 3])
        np.testing.assert_allclose(between, [0, 0, FINGERS_M], atol=EXACT_M)
        turn = flange[:3, :3].T @ tcp.rotation
        half = np.sqrt(0.5)
        np.testing.assert_allclose(
            turn, [[half, half, 0], [-half, half, 0], [0, 0, 1]], atol=EXACT_RAD
        )


def test_a_reflex_lies_above_the_contact_at_which_the_arm_retreats(profile: Profile) -> None:
    contact, franka = profile.limits.contact, profile.driver_options
    assert franka is not None
    assert contact.force_stop_n < franka.collision_force_n
    assert contact.torque_stop_nm < franka.collision_torque_nm
    assert contact.effort_stop_nm is not None
    assert contact.effort_stop_nm < min(franka.collision_joint_nm)
