"""Finger joints that are no opening: angles, and slides that count from elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from panda_arm import ARM_JOINTS, TCP_FRAME, URDF

from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import GripperProfile, JointEnds, Profile, load_profile
from vla_zenoh.robots.joint_reading import MOVING_M_S, JointReading
from vla_zenoh.types.records import Joints

EXACT_M = 1e-12
STROKE_M, SHUT_RAD = 0.085, 0.8
KNUCKLE, SLIDE = "knuckle", "panda_finger_joint1"
ROBOTIQ = JointEnds(0.0, SHUT_RAD, "rad")
ADDED = f"""
  <link name="knuckle_link"/>
  <joint name="{KNUCKLE}" type="revolute">
    <parent link="panda_hand"/><child link="knuckle_link"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="{SHUT_RAD}" effort="50" velocity="0.5"/>
  </joint>
</robot>"""
HAND = f"""
extends: panda_ros2
robot:
  description: {{urdf}}
  finger_joints: [{KNUCKLE}]
  gripper: {{{{max_width_m: {STROKE_M}, joint_open_rad: 0.0, joint_shut_rad: {SHUT_RAD}}}}}
"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """A Panda whose hand has a knuckle that turns, as well."""
    path = tmp_path / "panda.urdf"
    path.write_text(URDF.read_text().replace("</robot>", ADDED))
    return path


@pytest.fixture
def profile(urdf: Path, tmp_path: Path) -> Profile:
    (tmp_path / "lab.yaml").write_text(HAND.format(urdf=urdf))
    return load_profile(str(tmp_path / "lab.yaml"))


# -- openings -------------------------------------------------------------------------------------
@given(
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.floats(0, STROKE_M),
    st.integers(1, 6),
)
def test_an_opening_there_and_back_is_the_same(
    at_open: float, at_shut: float, width_m: float, count: int
) -> None:
    ends: dict[str, Any] = {"joint_open_rad": at_open, "joint_shut_rad": at_shut}
    if abs(at_open - at_shut) < 0.01:
        ends = {}
    fingers = Fingers(GripperProfile(max_width_m=STROKE_M, **ends), count)
    at = fingers.position(width_m)
    assert fingers.width_m([at] * count) == pytest.approx(width_m, abs=EXACT_M)
    low, high = sorted((at_open, at_shut))
    assert not ends or low - EXACT_M <= at <= high + EXACT_M


def test_fingers_that_slide_add_up_to_the_opening() -> None:
    fingers = Fingers(GripperProfile(max_width_m=0.08), 2)
    assert fingers.width_m([0.01, 0.02]) == pytest.approx(0.03)
    assert fingers.width_m([0.01]) == pytest.approx(0.02), "one stands for both"
    assert fingers.speed_m_s([-0.01, -0.01]) == pytest.approx(0.02)
    assert fingers.position(0.08) == pytest.approx(0.04)


# -- what is told ---------------------------------------------------------------------------------
def knuckle(at_rad: float, velocity_rad_s: float = 0.0) -> Joints:
    values = np.append(np.array(load_profile("panda_ros2").robot.home_rad), at_rad)
    velocities = np.append(np.zeros(7), velocity_rad_s)
    return Joints(0, (*ARM_JOINTS, KNUCKLE), values, velocities, None)


def test_a_knuckle_at_zero_is_an_open_gripper_and_one_at_its_end_a_shut_one(
    profile: Profile, urdf: Path
) -> None:
    arm = JointReading(
        profile, Kinematics(urdf, TCP_FRAME, ARM_JOINTS, (KNUCKLE,), finger_ends=ROBOTIQ)
    )
    for stamp_ns, (at_rad, width_m) in enumerate(
        ((0.0, STROKE_M), (SHUT_RAD, 0.0), (SHUT_RAD / 2, STROKE_M / 2)), 1
    ):
        arm.take(knuckle(at_rad), stamp_ns)
        assert arm.width_m == pytest.approx(width_m, abs=EXACT_M)
    slow_rad_s = 0.9 * MOVING_M_S * SHUT_RAD / STROKE_M
    for stamp_ns, (velocity_rad_s, moves) in enumerate(
        ((slow_rad_s, False), (-1.5 * slow_rad_s, True)), 4
    ):
        arm.take(knuckle(0.3, velocity_rad_s), stamp_ns)
        state = arm.gripper(busy=False, wanted_m=None, held=False)
        assert state is not None
        assert state.moving is moves
    with pytest.raises(CodecError, match="finger joint beyond"):
        arm.take(knuckle(100.0), 6)


# -- what a profile has to say --------------------------------------------------------------------
def test_the_hand_is_locked_where_it_is_wide_open(urdf: Path) -> None:
    arm = Kinematics(urdf, TCP_FRAME, ARM_JOINTS, (KNUCKLE,), finger_ends=ROBOTIQ)
    index = arm.full_model.joints[arm.full_model.getJointId(KNUCKLE)].idx_q
    assert arm.locked_position[index] == 0.0
    slides = JointEnds(0.0, 0.04, "m")
    arm = Kinematics(urdf, TCP_FRAME, ARM_JOINTS, (SLIDE,), finger_ends=slides)
    assert arm.locked_position[arm.full_model.joints[arm.full_model.getJointId(SLIDE)].idx_q] == 0.0


@pytest.mark.parametrize(
    ("joint", "ends", "said"),
    [
        (KNUCKLE, None, "turns, and its angle is no width.*joint_open_rad.*from 0 to 0.8 rad"),
        (KNUCKLE, JointEnds(0.0, 0.04, "m"), "turns: write gripper: {joint_open_rad"),
        (SLIDE, ROBOTIQ, "slides: write gripper: {joint_open_m"),
        (KNUCKLE, JointEnds(0.0, -0.8, "rad"), r"cannot be at gripper.joint_shut_rad \(-0.8\)"),
        (SLIDE, JointEnds(4.0, 0.0, "m"), r"cannot be at gripper.joint_open_m \(4\)"),
    ],
)
def test_a_finger_joint_of_which_too_little_is_said_is_refused(
    urdf: Path, joint: str, ends: JointEnds | None, said: str
) -> None:
    with pytest.raises(ProfileError, match=said):
        Kinematics(urdf, TCP_FRAME, ARM_JOINTS, (joint,), finger_ends=ends)


def test_an_end_a_little_beyond_the_description_is_taken(urdf: Path) -> None:
    for shut_rad in (0.7929, 0.85):
        ends = JointEnds(0.0, shut_rad, "rad")
        Kinematics(urdf, TCP_FRAME, ARM_JOINTS, (KNUCKLE,), finger_ends=ends)
