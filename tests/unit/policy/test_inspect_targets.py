"""Inspect Robots: what the numbers of its actions mean, and which are refused."""

from __future__ import annotations

import numpy as np
import pytest
from vla_zenoh_inspect.targets import GRIPPER, Targets

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import load_profile

PANDA = load_profile("panda_sim")
RATE_HZ = 10.0
HOME = np.array([*PANDA.robot.home_rad, 1.0])


@pytest.fixture(scope="module")
def targets() -> Targets:
    return Targets(PANDA, RATE_HZ)


def test_the_numbers_are_the_joints_and_the_gripper(targets: Targets) -> None:
    assert targets.labels == (*PANDA.robot.arm_joints, GRIPPER)
    assert targets.action.kind == "absolute"
    assert np.all(targets.low < HOME - 1e-3)
    assert np.all(targets.high >= HOME)


def test_a_small_motion_is_allowed(targets: Targets) -> None:
    target = HOME.copy()
    target[0] += 0.05
    assert targets.refusal(HOME, target) == ""


def test_a_target_beyond_a_joint_is_refused_by_its_name(targets: Targets) -> None:
    target = HOME.copy()
    target[3] = targets.high[3] + 0.1
    assert targets.refusal(HOME, target).startswith(f"joint_limit: {targets.labels[3]}")


def test_a_target_outside_the_workspace_is_refused_with_the_place(targets: Targets) -> None:
    target = HOME.copy()
    target[0] = 2.5
    assert "workspace" in targets.refusal(HOME, target)


def test_a_number_that_is_none_is_refused(targets: Targets) -> None:
    target = HOME.copy()
    target[-1] = np.nan
    assert targets.refusal(HOME, target).startswith(GRIPPER)


def test_a_path_names_its_waypoint(targets: Targets) -> None:
    path = np.stack([HOME, HOME])
    assert targets.refusal_of_path(HOME, path) == ""
    path[1, 3] = targets.high[3] + 0.1
    assert targets.refusal_of_path(HOME, path).startswith("waypoint 2 of 2: joint_limit")


def test_a_way_has_steps_that_the_arm_can_follow(targets: Targets) -> None:
    target = HOME.copy()
    target[0] += 1.0
    way = targets.way(HOME, target)
    steps = np.abs(np.diff(np.vstack([HOME, way]), axis=0))
    assert np.all(steps <= targets.most + 1e-12)
    np.testing.assert_allclose(way[-1], target)


def test_two_arms_are_no_embodiment() -> None:
    with pytest.raises(ProfileError, match="one arm"):
        Targets(load_profile("two_pandas_sim"), RATE_HZ)
