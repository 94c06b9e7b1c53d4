"""Gripper and grasp."""

from __future__ import annotations

import math

import numpy as np
import pytest
from motions import follow, line, make_world, wait

from vla_zenoh.errors import RecordError
from vla_zenoh.simulation.world import World
from vla_zenoh.types import PoseReference

BRICK_WIDTH_M = 0.0318
WIDTH_ATOL_M = 3e-4
TURNED_WIDTH_ATOL_M = 1.5e-3  # a brick grasped askew takes a second to turn flat
GRASP_M = (0.0, 0.0, 0.012 - 0.16)  # from home down to the middle of the brick
SLIP_LIMIT_M = 1e-3
LIFT_M = 0.10
LIFT_ATOL_M = 2e-3
BRICK_WEIGHT_N = 0.012 * 9.81
FORCE_RTOL = 0.05


def grasp(world: World, yaw_rad: float = 0.0, force_n: float = 20.0) -> PoseReference:
    turn = (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
    world.place("brick", (0.43, 0.0, 0.0096), turn)
    reference, _, _ = follow(world, line(world.hold_reference(), GRASP_M, 0.5))
    world.set_gripper(0.0, 0.1, force_n)
    wait(world, reference, 0.7)
    return reference


@pytest.mark.parametrize("yaw_rad", [0.0, pytest.param(0.1, marks=pytest.mark.long)])
def test_a_brick_is_grasped_lifted_and_does_not_slip(yaw_rad: float) -> None:
    world = make_world()
    reference = grasp(world, yaw_rad)
    state = world.gripper_state()
    assert state.holding
    assert not state.moving
    tolerance_m = TURNED_WIDTH_ATOL_M if yaw_rad else WIDTH_ATOL_M
    assert state.width_m == pytest.approx(BRICK_WIDTH_M, abs=tolerance_m)

    resting_m = world.objects()["brick"][0][2]
    reference, _, _ = follow(world, line(reference, (0.0, 0.0, LIFT_M), 0.5))
    held = world.objects()["brick"][0] - world.tcp()[0]
    wait(world, reference, 1.5)
    brick = world.objects()["brick"][0]
    assert brick[2] - resting_m == pytest.approx(LIFT_M, abs=LIFT_ATOL_M)
    assert np.linalg.norm(brick - world.tcp()[0] - held) < SLIP_LIMIT_M
    assert world.gripper_state().holding
    assert world.wrench()[2] == pytest.approx(-BRICK_WEIGHT_N, rel=FORCE_RTOL)


def test_an_opened_gripper_lets_go() -> None:
    world = make_world()
    reference = grasp(world)
    reference, _, _ = follow(world, line(reference, (0.0, 0.0, LIFT_M), 0.5))
    world.set_gripper(0.08, 0.1, 20.0)
    wait(world, reference, 1.0)
    assert not world.gripper_state().holding
    assert world.objects()["brick"][0][2] < 0.02


def test_a_close_command_said_again_does_not_drop_the_brick() -> None:
    world = make_world()
    reference = grasp(world)
    reference, _, _ = follow(world, line(reference, (0.0, 0.0, LIFT_M), 0.5))
    held = world.objects()["brick"][0][2]
    for _ in range(10):
        world.set_gripper(0.0, 0.1, 20.0)
        assert world.gripper_state().holding
        wait(world, reference, 0.05)
    assert world.objects()["brick"][0][2] == pytest.approx(held, abs=SLIP_LIMIT_M)


def test_closing_on_nothing_is_not_holding() -> None:
    world = make_world()
    world.set_gripper(0.0, 0.1, 20.0)
    wait(world, world.hold_reference(), 1.0)
    state = world.gripper_state()
    assert not state.holding
    assert not state.moving
    assert state.width_m == pytest.approx(0.0, abs=WIDTH_ATOL_M)


def test_the_width_runs_at_the_commanded_speed() -> None:
    world = make_world()
    reference = world.hold_reference()
    world.set_gripper(0.02, 0.05, 20.0)
    assert world.gripper_state().moving
    wait(world, reference, 0.6)
    assert world.gripper_state().width_m == pytest.approx(0.08 - 0.6 * 0.05, abs=1e-3)
    assert world.gripper_state().moving
    wait(world, reference, 0.8)
    assert world.gripper_state().width_m == pytest.approx(0.02, abs=WIDTH_ATOL_M)
    assert not world.gripper_state().moving


@pytest.mark.parametrize("force_n", [5.0, 30.0])
def test_the_fingers_press_with_the_commanded_force(force_n: float) -> None:
    world = make_world()
    grasp(world, force_n=force_n)
    assert world.parts[""].gripper.force_n == pytest.approx(force_n, rel=FORCE_RTOL)


def test_a_gripper_command_without_speed_is_refused() -> None:
    with pytest.raises(RecordError, match="speed and force above 0"):
        make_world().set_gripper(0.05, 0.0, 20.0)
