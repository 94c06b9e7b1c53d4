"""Targets are judged before the arm moves, by the bounds that act in motion."""

from __future__ import annotations

import numpy as np
import pytest
from panda_arm import HOME_RAD
from vla_zenoh_primitives.target_check import TargetCheck

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.profile import load_profile, override

PROFILE = load_profile("panda_sim")
HOME = np.array(PROFILE.robot.home_rad)


@pytest.fixture(scope="module")
def check() -> TargetCheck:
    return TargetCheck(PROFILE, ReachabilityFilter(PROFILE))


def moved(check: TargetCheck, by_m: tuple[float, float, float]) -> Pose:
    home = check.kinematics.forward(HOME)
    return Pose(home.position_m + by_m, home.rotation)


def test_poses_all_over_the_table_are_allowed(check: TargetCheck) -> None:
    for by_m in ((0.2, 0.0, 0.0), (0.0, 0.3, 0.1), (-0.1, -0.3, 0.3), (0.1, 0.1, -0.1)):
        assert check.pose_fault(HOME, moved(check, by_m)) == ""


def test_where_the_arm_stands_is_always_allowed(check: TargetCheck) -> None:
    assert check.pose_fault(HOME, moved(check, (0.0, 0.0, 0.0))) == ""
    assert check.joints_fault(HOME, HOME) == ""


@pytest.mark.parametrize(
    ("by_m", "words"),
    [
        ((0.0, 0.0, -0.3), "workspace"),
        ((0.6, 0.0, 0.0), "workspace"),
        ((0.31, 0.44, 0.7), "before the target"),
    ],
)
def test_poses_out_of_bounds_are_named_with_the_limit(
    check: TargetCheck, by_m: tuple[float, float, float], words: str
) -> None:
    assert words in check.pose_fault(HOME, moved(check, by_m))


def test_a_tool_that_would_turn_into_the_table_is_not_allowed(check: TargetCheck) -> None:
    low = moved(check, (0.0, 0.0, -0.14))
    assert check.pose_fault(HOME, low) == ""
    turned = Pose(low.position_m, exp3(np.array([0.0, 1.4, 0.0])) @ low.rotation)
    assert "table_distance" in check.pose_fault(HOME, turned)


def test_a_keep_out_on_the_way_is_named() -> None:
    post = {"centre_m": [0.55, 0.22, 0.3], "box_m": [0.2, 0.04, 0.6]}
    profile = override(PROFILE, {"limits": {"reach": {"keep_out": {"post": post}}}})
    check = TargetCheck(profile, ReachabilityFilter(profile))
    behind = moved(check, (0.1, 0.4, 0.0))
    assert check.pose_fault(HOME, moved(check, (0.1, -0.3, 0.0))) == ""
    assert "post" in check.pose_fault(HOME, behind)


def test_joints_beyond_their_range_are_named_with_it(check: TargetCheck) -> None:
    asked = HOME.copy()
    asked[3] = 0.5
    assert check.joints_fault(HOME, asked).startswith("joint_limit: panda_joint4 at 0.5 rad")
    asked[3], asked[1] = HOME[3], 1.2
    assert check.joints_fault(HOME, asked) != ""


def test_home_of_the_tests_is_that_of_the_profile() -> None:
    assert pytest.approx(HOME) == HOME_RAD
