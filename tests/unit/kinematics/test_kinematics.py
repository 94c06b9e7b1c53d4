"""The arm's kinematics against plain Pinocchio on the whole robot, and against differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from panda_arm import ARM_JOINTS, FINGER_JOINTS, HOME_RAD, TCP_FRAME, URDF, panda

from vla_zenoh.errors import ProfileError, RecordError
from vla_zenoh.kinematics.kinematics import Kinematics, smallest_singular_value
from vla_zenoh.kinematics.so3 import log3
from vla_zenoh.types import FloatArray, JointState

EXACT = 1e-12  # m and rad
DIFFERENCE_STEP_RAD = 1e-6
JACOBIAN_TOLERANCE = 1e-8  # m and rad per rad
HOME_TOLERANCE_M = 1e-9

KINEMATICS = panda()
SHARES = st.lists(st.floats(0, 1), min_size=7, max_size=7)


def joints_at(shares: list[float]) -> FloatArray:
    span = KINEMATICS.upper_rad - KINEMATICS.lower_rad
    return KINEMATICS.lower_rad + np.array(shares) * span


@given(SHARES)
def test_the_reduced_arm_is_where_the_whole_robot_says(shares: list[float]) -> None:
    joints = joints_at(shares)
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.append(joints, [0.01, 0.03]))
    expected = data.oMf[model.getFrameId(TCP_FRAME)]
    pose = KINEMATICS.forward(joints)
    assert np.abs(pose.position_m - expected.translation).max() < EXACT
    assert np.abs(pose.rotation - expected.rotation).max() < EXACT


@given(SHARES)
def test_the_jacobian_is_what_differences_say(shares: list[float]) -> None:
    joints = joints_at(shares)
    jacobian = KINEMATICS.jacobian(joints)
    assert jacobian.shape == (6, 7)
    for column in range(7):
        step = np.zeros(7)
        step[column] = DIFFERENCE_STEP_RAD
        after, before = KINEMATICS.forward(joints + step), KINEMATICS.forward(joints - step)
        turn = log3(after.rotation @ before.rotation.T)
        twist = np.append(after.position_m - before.position_m, turn) / (2 * DIFFERENCE_STEP_RAD)
        assert np.abs(jacobian[:, column] - twist).max() < JACOBIAN_TOLERANCE


@given(SHARES)
def test_pose_and_jacobian_together_are_the_same(shares: list[float]) -> None:
    joints = joints_at(shares)
    pose, jacobian = KINEMATICS.pose_and_jacobian(joints)
    alone = KINEMATICS.forward(joints)
    assert np.array_equal(pose.position_m, alone.position_m)
    assert np.array_equal(pose.rotation, alone.rotation)
    assert np.array_equal(jacobian, KINEMATICS.jacobian(joints))


def test_a_pose_stays_what_it_was_when_the_arm_is_asked_again() -> None:
    pose = KINEMATICS.forward(HOME_RAD)
    kept = pose.position_m.copy()
    KINEMATICS.forward(HOME_RAD + 0.3)
    assert np.array_equal(pose.position_m, kept)


def test_the_home_pose_of_the_profile_is_where_it_says() -> None:
    pose = KINEMATICS.forward(HOME_RAD)
    assert np.abs(pose.position_m - (0.43, 0.0, 0.16)).max() < HOME_TOLERANCE_M
    assert np.abs(pose.rotation - np.diag([1.0, -1.0, -1.0])).max() < HOME_TOLERANCE_M


def test_limits_are_those_of_the_urdf() -> None:
    assert KINEMATICS.lower_rad[3] == -3.0718
    assert KINEMATICS.upper_rad[3] == -0.0698
    assert KINEMATICS.velocity_rad_s.tolist() == [2.175] * 4 + [2.61] * 3


@given(st.permutations(range(9)))
def test_joints_are_found_by_name_in_any_order_and_among_others(order: list[int]) -> None:
    names = np.array([*ARM_JOINTS, *FINGER_JOINTS])[order]
    values = np.append(HOME_RAD, [0.01, 0.02])[order]
    state = JointState(tuple(names.tolist()), values, np.zeros(9), np.zeros(9))
    assert np.array_equal(KINEMATICS.joints_of(state), HOME_RAD)


def test_the_order_of_the_profile_does_not_matter() -> None:
    shuffled = Kinematics(URDF, TCP_FRAME, ARM_JOINTS[::-1], FINGER_JOINTS)
    assert shuffled.arm_joints == ARM_JOINTS
    given_rad = shuffled.ordered(ARM_JOINTS[::-1], HOME_RAD[::-1])
    assert np.array_equal(given_rad, HOME_RAD)


def test_a_missing_joint_is_named() -> None:
    state = JointState(ARM_JOINTS[:-1], np.zeros(6), np.zeros(6), np.zeros(6))
    with pytest.raises(RecordError, match="panda_joint7"):
        KINEMATICS.joints_of(state)


def test_a_base_frame_that_moves_is_refused() -> None:
    with pytest.raises(ProfileError, match="moves with the arm"):
        Kinematics(URDF, TCP_FRAME, ARM_JOINTS, FINGER_JOINTS, base_frame="panda_link1")


def test_a_turned_base_turns_pose_and_jacobian(tmp_path: Path) -> None:
    turned = tmp_path / "turned.urdf"
    text = URDF.read_text()
    mount = (
        '<link name="stand"/><joint name="mount" type="fixed"><parent link="stand"/>'
        '<child link="panda_link0"/><origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/></joint></robot>'
    )
    turned.write_text(text.replace("</robot>", mount))
    in_base = Kinematics(turned, TCP_FRAME, ARM_JOINTS, FINGER_JOINTS, base_frame="panda_link0")
    pose, jacobian = in_base.pose_and_jacobian(HOME_RAD)
    expected = KINEMATICS.forward(HOME_RAD)
    assert np.abs(pose.position_m - expected.position_m).max() < EXACT
    assert np.abs(pose.rotation - expected.rotation).max() < EXACT
    assert np.abs(jacobian - KINEMATICS.jacobian(HOME_RAD)).max() < EXACT
    at_root = Kinematics(turned, TCP_FRAME, ARM_JOINTS, FINGER_JOINTS).forward(HOME_RAD)
    assert np.abs(at_root.position_m - expected.position_m).max() > 0.1


@pytest.mark.parametrize(
    ("tcp_frame", "joints", "message"),
    [
        ("panda_hand_tpc", ARM_JOINTS, "did you mean 'panda_hand_tcp'"),
        (
            TCP_FRAME,
            ("panda_joint8", *ARM_JOINTS[1:]),
            "joint 'panda_joint8' of panda.urdf is fixed",
        ),
        (TCP_FRAME, ("panda_jiont1", *ARM_JOINTS[1:]), "did you mean 'panda_joint1'"),
    ],
)
def test_a_wrong_name_is_refused_with_the_nearest(
    tcp_frame: str, joints: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ProfileError, match=message):
        Kinematics(URDF, tcp_frame, joints, FINGER_JOINTS)


def test_a_joint_that_floats_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "floating.urdf"
    text = URDF.read_text()
    start = text.index('<joint name="panda_joint1"')
    end = text.index("</joint>", start)
    joint = text[start:end].replace('type="revolute"', 'type="floating"')
    broken.write_text(text[:start] + joint + text[end:])
    with pytest.raises(ProfileError, match="is floating: an arm's joint turns about"):
        Kinematics(broken, TCP_FRAME, ARM_JOINTS, FINGER_JOINTS)


@given(SHARES)
def test_the_smallest_singular_value_is_that_of_the_decomposition(shares: list[float]) -> None:
    jacobian = KINEMATICS.jacobian(joints_at(shares))
    values = np.linalg.svd(jacobian, compute_uv=False)
    assert abs(smallest_singular_value(jacobian) - values[-1]) < 1e-7


def test_a_stretched_arm_is_singular_and_home_is_not() -> None:
    stretched = np.zeros(7)
    assert smallest_singular_value(KINEMATICS.jacobian(stretched)) < 1e-7
    assert smallest_singular_value(KINEMATICS.jacobian(HOME_RAD)) > 0.2


def test_an_arm_of_fewer_than_six_joints_has_a_singular_value_too() -> None:
    jacobian = KINEMATICS.jacobian(HOME_RAD)[:, :4]
    expected = np.linalg.svd(jacobian, compute_uv=False)[-1]
    assert abs(smallest_singular_value(jacobian) - expected) < 1e-7
