"""Choosing a home pose."""

from __future__ import annotations

import numpy as np
import pytest
from motions import HOME_RAD, SCENE, make_world

from scripts.home_pose import TOOL_DOWN, solve_home
from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.robot_model import RobotModel

HOME_M = (0.43, 0.0, 0.16)
JOINT_ATOL_RAD = 1e-7
POSE_ATOL_M = 1e-8


def test_the_home_joints_are_those_of_a_tool_pointing_straight_down() -> None:
    solved = solve_home(SCENE, RobotModel(), HOME_M)
    np.testing.assert_allclose(solved, HOME_RAD, atol=JOINT_ATOL_RAD)
    position, rotation = make_world().tcp()
    np.testing.assert_allclose(position, HOME_M, atol=POSE_ATOL_M)
    np.testing.assert_allclose(rotation, TOOL_DOWN, atol=JOINT_ATOL_RAD)


@pytest.mark.parametrize("height_m", [0.06, 0.66])
def test_from_home_the_tool_reaches_half_a_metre_up_and_ten_centimetres_down(
    height_m: float,
) -> None:
    solve_home(SCENE, RobotModel(), (*HOME_M[:2], height_m))


def test_a_pose_out_of_reach_is_refused() -> None:
    with pytest.raises(ResourceError, match=r"no joints put the TCP"):
        solve_home(SCENE, RobotModel(), (1.5, 0.0, 0.2))
