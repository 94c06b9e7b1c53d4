"""The simulated arm under joint impedance control, and its change from and to the Cartesian law."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest
from motions import HOME_RAD, SCENE, line, make_world, still

from vla_zenoh.robots.sim_driver import in_world_time
from vla_zenoh.simulation.pace import MAX_STEPS
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import PREFIX, STEP_S
from vla_zenoh.simulation.world import World
from vla_zenoh.types import FloatArray, JointReference, PoseReference

FOLLOW_LIMIT_M, FOLLOW_LIMIT_RAD = 1e-3, 2e-3
FRICTION_NM = 0.5
FRICTION_FOLLOW_LIMIT_RAD = 0.015
FRICTION_LIMIT_RAD = 1e-3
SETTLE_S = 3.0
CHANGE_LIMIT_M, CHANGE_LIMIT_RAD = 2e-4, 2e-3
LOAD_NM = 2.0
SAME_POSE_M = 1e-9
REST_RAD_S = 1e-3
TAKEN_OVER = [
    (0.0, 0.3),
    pytest.param(FRICTION_NM, 0.3, marks=pytest.mark.long),
    pytest.param(FRICTION_NM, SETTLE_S, marks=pytest.mark.long),
]
"""Friction, and how long the first law has held the arm: it has found the friction, or has not."""
SWING_RAD = np.array([0.5, 0.3, -0.4, 0.4, 0.5, -0.4, 0.8])


def swing(start_rad: FloatArray, by_rad: FloatArray, duration_s: float) -> Iterator[JointReference]:
    """From rest to rest with a minimum-jerk profile, one reference a tick."""
    ticks = round(duration_s / STEP_S)
    for tick in range(1, ticks + 1):
        s = tick / ticks
        yield JointReference(
            start_rad + (10 * s**3 - 15 * s**4 + 6 * s**5) * by_rad,
            (30 * s**2 - 60 * s**3 + 30 * s**4) / duration_s * by_rad,
            (60 * s - 180 * s**2 + 120 * s**3) / duration_s**2 * by_rad,
        )


def follow_joints(
    world: World, references: Iterator[JointReference]
) -> tuple[JointReference, float]:
    """Run; the last reference at rest, and the largest error of any joint."""
    reference, worst_rad = resting(world), 0.0
    for reference in references:
        world.tick(reference)
        error = world.joint_state().position_rad - reference.position_rad
        worst_rad = max(worst_rad, float(np.abs(error).max()))
    return JointReference.at_rest(reference.position_rad), worst_rad


def resting(world: World) -> JointReference:
    return JointReference.at_rest(world.joint_state().position_rad)


def hold(world: World, reference: PoseReference | JointReference, duration_s: float) -> None:
    for _ in range(round(duration_s / STEP_S)):
        world.tick(reference)


def moved_while(
    world: World, reference: PoseReference | JointReference, duration_s: float
) -> tuple[float, float]:
    """Farthest the TCP (m) and any joint (rad) get from where they are."""
    at_m, at_rad = world.tcp()[0], world.joint_state().position_rad
    worst_m = worst_rad = 0.0
    for _ in range(round(duration_s / STEP_S)):
        hold(world, reference, STEP_S)
        worst_m = max(worst_m, float(np.linalg.norm(world.tcp()[0] - at_m)))
        turned = np.abs(world.joint_state().position_rad - at_rad)
        worst_rad = max(worst_rad, float(turned.max()))
    return worst_m, worst_rad


# -- following --------------------------------------------------------------------------------
@pytest.mark.parametrize("friction_nm", [0.0, FRICTION_NM])
def test_a_smooth_swing_of_all_joints_is_followed(friction_nm: float) -> None:
    world = make_world(friction_nm=friction_nm)
    path = swing(np.array(HOME_RAD), SWING_RAD, 2.0)
    reference, worst_rad = follow_joints(world, path)
    # Friction is not in the model: in motion the softest spring, that of joint 7, carries it.
    assert worst_rad < (FRICTION_FOLLOW_LIMIT_RAD if friction_nm else FOLLOW_LIMIT_RAD)
    hold(world, reference, SETTLE_S if friction_nm else 0.5)
    error = np.abs(world.joint_state().position_rad - reference.position_rad)
    assert error.max() < FRICTION_LIMIT_RAD
    assert np.abs(world.joint_state().velocity_rad_s).max() < REST_RAD_S
    assert world.saturated == 0


def test_it_is_followed_as_well_where_control_is_computed_as_rarely_as_ever() -> None:
    world, worst_rad = make_world(), 0.0
    path = swing(np.array(HOME_RAD), SWING_RAD, 2.0)
    for reference in islice(path, MAX_STEPS - 1, None, MAX_STEPS):
        world.tick(in_world_time(reference, 1.0, MAX_STEPS), MAX_STEPS)
        error = np.abs(world.joint_state().position_rad - reference.position_rad)
        worst_rad = max(worst_rad, float(error.max()))
    assert worst_rad < FOLLOW_LIMIT_RAD


def test_the_same_references_give_the_same_state_to_the_bit() -> None:
    ends = []
    for _ in range(2):
        world = make_world(seed=3, friction_nm=FRICTION_NM)
        follow_joints(world, swing(np.array(HOME_RAD), SWING_RAD, 0.3))
        ends.append(world.qpos())
    assert np.array_equal(*ends)


def test_the_state_tells_the_joints_that_are_held() -> None:
    world = make_world()
    state = world.joint_state()
    assert np.array_equal(state.reference_rad, state.position_rad)
    reference = JointReference.at_rest(np.array(HOME_RAD) + 0.01)
    world.tick(reference)
    assert np.array_equal(world.joint_state().reference_rad, reference.position_rad)
    world.tick(world.hold_reference())
    state = world.joint_state()
    assert np.array_equal(state.reference_rad, state.position_rad)


def test_the_reference_pose_is_where_the_held_joints_put_the_tcp() -> None:
    world = make_world()
    path = list(swing(np.array(HOME_RAD), SWING_RAD, 0.5))
    for reference in path:
        world.tick(reference)
    before = world.qpos()
    state = world.pose_state(path[-1])
    assert np.array_equal(before, world.qpos())
    there = World(SCENE, [RobotModel()], home_rad=[path[-1].position_rad])
    assert state.reference_position_m is not None
    np.testing.assert_allclose(state.reference_position_m, there.tcp()[0], atol=SAME_POSE_M)
    assert 0.0 < np.linalg.norm(state.position_m - state.reference_position_m) < FOLLOW_LIMIT_M


# -- from one law to the other ----------------------------------------------------------------
@pytest.mark.parametrize(("friction_nm", "waits_s"), TAKEN_OVER)
def test_the_arm_does_not_move_when_joints_take_over_from_a_pose(
    friction_nm: float, waits_s: float
) -> None:
    world = make_world(friction_nm=friction_nm)
    start = world.hold_reference()
    for reference in line(start, (0.1, 0.15, 0.2), 1.5):
        world.tick(reference)
    hold(world, still(reference), waits_s)
    moved_m, moved_rad = moved_while(world, resting(world), 1.0)
    assert moved_m < CHANGE_LIMIT_M
    assert moved_rad < CHANGE_LIMIT_RAD


@pytest.mark.parametrize(("friction_nm", "waits_s"), TAKEN_OVER)
def test_the_arm_does_not_move_when_a_pose_takes_over_from_joints(
    friction_nm: float, waits_s: float
) -> None:
    world = make_world(friction_nm=friction_nm)
    reference, _ = follow_joints(world, swing(np.array(HOME_RAD), SWING_RAD, 1.0))
    hold(world, reference, waits_s)
    moved_m, moved_rad = moved_while(world, world.hold_reference(), 1.0)
    assert moved_m < CHANGE_LIMIT_M
    assert moved_rad < CHANGE_LIMIT_RAD


def loaded_world() -> World:
    """Its shoulder is pulled at by a spring that no controller knows of."""
    world = make_world()
    shoulder = world.model.joint(PREFIX + RobotModel().arm_joints[1])
    world.model.jnt_stiffness[shoulder.id] = LOAD_NM
    world.model.qpos_spring[shoulder.qposadr[0]] = HOME_RAD[1] + 1.0
    return world


@pytest.mark.parametrize("first", ["pose", "joint"])
def test_a_load_is_carried_on_by_the_law_that_takes_over(first: str) -> None:
    world = loaded_world()
    pose, joints = world.hold_reference(), resting(world)
    hold(world, pose if first == "pose" else joints, SETTLE_S)
    heres = (world.hold_reference(), resting(world))
    here = heres[1] if first == "pose" else heres[0]
    moved_m, moved_rad = moved_while(world, here, 1.0)
    assert moved_m < CHANGE_LIMIT_M
    assert moved_rad < CHANGE_LIMIT_RAD
    world.parts[""].reset_laws()  # nobody was in charge: it has to find the load by itself
    assert moved_while(world, here, 1.0)[0] > 2 * CHANGE_LIMIT_M


def test_the_elbow_stays_where_joints_left_it_until_a_reset() -> None:
    world = make_world()
    reference, _ = follow_joints(world, swing(np.array(HOME_RAD), SWING_RAD, 1.0))
    hold(world, reference, 0.5)
    hold(world, world.hold_reference(), 1.0)
    turned = world.joint_state().position_rad - reference.position_rad
    assert np.abs(turned).max() < CHANGE_LIMIT_RAD
    world.reset()
    hold(world, world.hold_reference(), 1.0)
    np.testing.assert_allclose(world.joint_state().position_rad, HOME_RAD, atol=1e-4)
