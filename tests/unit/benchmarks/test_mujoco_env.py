"""What the benchmarks with MuJoCo share: state, images and the meaning of a step."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from vla_zenoh_benchmarks.mujoco_env import MujocoEnvironment, delta_action, quat_xyzw

SCENE = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


def test_the_state_is_that_of_the_simulation_and_closing_needs_no_image() -> None:
    env = MujocoEnvironment()
    model = mujoco.MjModel.from_xml_string(SCENE)
    env._env = SimpleNamespace(model=model, data=mujoco.MjData(model))
    env.close()
    assert env.physics() == pytest.approx([0, 0, 0, 1, *[0] * 9])


def test_a_quarter_turn_is_told_as_x_y_z_w() -> None:
    turn = np.array([0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert quat_xyzw(turn) == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_the_gripper_of_a_step_closes_above_zero() -> None:
    action = delta_action(0.05, 0.1)
    assert (action.position_scale_m, action.dt_s) == (0.05, 0.1)
    assert (action.gripper, action.gripper_open_is_high, action.gripper_threshold) == (
        "binary",
        False,
        0.0,
    )
