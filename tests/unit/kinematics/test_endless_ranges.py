"""Joints that turn without an end: what is computed with the ranges of joints is right for them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from endless_arm import ENDLESS, HOME_RAD, endless_arm
from made_arm import TURN_RAD, made_arm

from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.kinematics import InverseKinematics, make_kinematics
from vla_zenoh.kinematics.plausibility import implausible
from vla_zenoh.kinematics.so3 import Pose, exp3, pose_distance
from vla_zenoh.profile import Profile, override

HOME = np.array(HOME_RAD)
TURN = 2 * math.pi
MANY = np.array([7, 0, 0, -4, 0, 100]) * TURN
"""Whole turns of the joints that have no end."""


@pytest.fixture
def profile(tmp_path: Path) -> Profile:
    return endless_arm(tmp_path)


def test_it_has_no_ends_but_its_velocity(profile: Profile) -> None:
    arm = make_kinematics(profile)
    assert tuple(np.array(arm.arm_joints)[arm.endless]) == ENDLESS
    assert np.isneginf(arm.lower_rad[arm.endless]).all()
    assert np.isposinf(arm.upper_rad[arm.endless]).all()
    assert np.isfinite(arm.velocity_rad_s).all()
    low, high = arm.sampled_rad
    assert np.isfinite([low, high]).all()
    assert (high - low)[arm.endless] == pytest.approx(TURN)


def test_after_whole_turns_the_arm_is_in_the_same_place(profile: Profile) -> None:
    arm = make_kinematics(profile)
    apart = pose_distance(arm.forward(HOME), arm.forward(HOME + MANY))
    assert max(apart) < 1e-9
    assert arm.nearest(HOME, HOME + MANY) == pytest.approx(HOME + MANY)
    assert arm.nearest(HOME + MANY, HOME) == pytest.approx(HOME)


def test_a_range_in_the_profile_ends_it(profile: Profile) -> None:
    ranges = [[-2.0, 3.1], None, [-1.0, 2.0], None, None, None]
    arm = make_kinematics(override(profile, {"robot": {"joint_range_rad": ranges}}))
    assert arm.endless.tolist() == [False, False, False, True, False, True]
    assert arm.lower_rad[:3] == pytest.approx([-2.0, -TURN_RAD, -1.0])


def test_without_a_velocity_it_is_rejected_by_name(profile: Profile) -> None:
    urdf = Path(profile.robot.description)
    text = urdf.read_text()
    urdf.write_text(text.replace('<limit  velocity="2.0" effort="60.0"/>', "", 1))
    assert urdf.read_text() != text
    with pytest.raises(ProfileError, match=r"'joint1' .* velocity > 0"):
        make_kinematics(profile)


def test_the_joints_of_a_pose_are_near_whatever_was_turned_before(profile: Profile) -> None:
    arm = make_kinematics(profile)
    solver = InverseKinematics(arm, HOME)
    start = HOME + MANY
    here = arm.forward(start)
    goal = Pose(here.position_m, here.rotation @ exp3(np.array([0.4, 0.0, 0.0])))
    found = solver.approach(goal, start)
    assert found.solved
    # The flange turns past half a turn, and nothing turns back.
    assert found.joints_rad - start == pytest.approx([0, 0, 0, 0, 0, 0.4], abs=1e-5)


@pytest.mark.parametrize("turns", [0, 5])
def test_the_elbow_of_a_redundant_arm_goes_to_its_posture_on_the_shortest_way(
    tmp_path: Path, turns: int
) -> None:
    profile = made_arm(tmp_path, "eztyeztytzexty", 0.2)
    arm = make_kinematics(profile)
    posture = np.array([0.3, -0.8, 0.1, 1.6, 0.2, 3.0, 0.7])
    solver = InverseKinematics(arm, posture)
    joints = posture + 0.1 * np.array([1, -1, 1, 1, -1, 1, 1]) + turns * TURN * arm.endless
    here, away = arm.forward(joints), []
    for step in range(200):
        to_and_fro_m = here.position_m + [0.0, 0.0, 0.001 * (step % 2)]
        joints = solver.approach(Pose(to_and_fro_m, here.rotation), joints).joints_rad
        away.append(float(np.linalg.norm(joints - turns * TURN * arm.endless - posture)))
    assert away[-1] < 0.97 * away[0]
    assert max(away) < 1.01 * away[0]


def test_nothing_about_it_is_implausible_and_its_bounds_are_no_limits(profile: Profile) -> None:
    reach = ReachabilityFilter(profile)
    arm = reach.kinematics
    assert not list(implausible(arm, profile.limits, reach.barriers.collisions))
    reach.reset(HOME + MANY)
    assert math.isfinite(reach.margins.joint_rad)
    assert reach.margins.joint not in ENDLESS
    bounds = JointBounds(profile, arm, reach.barriers)
    asked, hits = bounds.into_ranges(HOME + MANY, HOME + MANY + 0.1)
    assert asked == pytest.approx(HOME + MANY + 0.1)
    assert not hits
