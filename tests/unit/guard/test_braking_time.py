"""The robot's own stop takes no longer than is said, from any motion that it may have followed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from guard_rig import stop_from
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.limits import joint_motion_limits
from vla_zenoh.control.smoothing import Motion, Smoother
from vla_zenoh.guard.arm_guard import max_braking_time_s
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.guard.stream_guard import pose_brake_limits
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import JointReference

SIM = load_profile("panda_sim")
TICK_S = 0.01
TICKS = 2
"""A brake is planned, and found to be over, from tick to tick."""
LOOSE = 1.25
"""What is said is longer than the longest by no more than this factor."""
HERE = Pose(np.array([0.4, 0.0, 0.4]), np.eye(3))

velocities, accelerations, jerks = st.floats(0.05, 1.7), st.floats(0.2, 10), st.floats(1, 500)
signs = st.sampled_from([-1.0, 0.0, 1.0])


def slow(command: str, **limits: Any) -> Profile:
    return override(SIM, {"robot": {"command": command}, "limits": limits})


def brake_s(profile: Profile, twist: Any, acceleration: Any) -> float:
    """How long the guard's own stop takes from there."""
    smoother = Smoother(HERE, TICK_S, pose_brake_limits(profile))
    smoother.brake_from(Motion(HERE, np.array(twist), np.array(acceleration)))
    ticks = 0
    while not smoother.at_rest:
        smoother.tick()
        ticks += 1
    return ticks * TICK_S


@settings(max_examples=25)
@given(velocities, accelerations, jerks, signs, signs)
def test_no_stop_of_the_tcp_takes_longer(
    velocity: float, acceleration: float, jerk: float, one: float, other: float
) -> None:
    profile = slow(
        "pose",
        translation={
            "velocity_m_s": velocity,
            "acceleration_m_s2": acceleration,
            "jerk_m_s3": jerk,
        },
        rotation={
            "velocity_rad_s": velocity,
            "acceleration_rad_s2": acceleration,
            "jerk_rad_s3": jerk,
        },
    )
    v, a = BRAKE_MARGIN * velocity, BRAKE_MARGIN * acceleration
    took_s = brake_s(profile, [v, one * v, 0, 0, v, 0], [other * a, a, 0, 0, a, 0])
    assert took_s <= max_braking_time_s(profile) - profile.timing.command_timeout_s + TICKS * TICK_S


@settings(max_examples=25)
@given(st.lists(st.tuples(velocities, accelerations, jerks, signs), min_size=7, max_size=7))
def test_no_stop_of_the_joints_takes_longer(axes: list[tuple[float, float, float, float]]) -> None:
    v, a, j, sign = (np.array(column) for column in zip(*axes, strict=True))
    profile = slow(
        "joint",
        joint={
            "velocity_rad_s": v.tolist(),
            "acceleration_rad_s2": a.tolist(),
            "jerk_rad_s3": j.tolist(),
        },
    )
    motion = JointReference(np.zeros(7), BRAKE_MARGIN * v, BRAKE_MARGIN * a * sign)
    stop = stop_from(motion, joint_motion_limits(profile, BRAKE_MARGIN))
    assert stop is not None
    assert stop.duration <= max_braking_time_s(profile) - profile.timing.command_timeout_s


@pytest.mark.parametrize("acceleration", [2.0, 0.25])
def test_it_is_not_said_to_take_much_longer_than_it_may(acceleration: float) -> None:
    profile = slow("pose", translation={"acceleration_m_s2": acceleration})
    limits = pose_brake_limits(profile)
    speed, change, _ = limits.translation
    spin, spin_change, _ = limits.rotation
    twist, acceleration_now = [speed, 0, 0, spin, 0, 0], [change, 0, 0, spin_change, 0, 0]
    needed_s = brake_s(profile, twist, acceleration_now) + profile.timing.command_timeout_s
    assert needed_s < max_braking_time_s(profile) + TICKS * TICK_S
    assert max_braking_time_s(profile) < LOOSE * needed_s
