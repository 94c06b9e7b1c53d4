"""The simulated world: repeatable, placed by seed, reporting what a robot reports."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from motions import HOME_RAD, circle, line, make_world, wait

from vla_zenoh.errors import NodeError, ResourceError
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import draw_places, footprint_m, objects_of, regions_of
from vla_zenoh.simulation.world import World
from vla_zenoh.types import PoseReference

TABLE_CLEARANCE_M = 2e-4  # how deep a resting brick sinks into the table at most
SEEDS = range(40)
POSE_ATOL = 1e-9  # m, rad; finite differences aside, both sides come from the same state
TWIST_ATOL_M_S = 2e-3


def run(world: World, look: bool) -> np.ndarray:
    start = world.hold_reference()
    world.set_gripper(0.02, 0.1, 20.0)
    for reference in itertools.islice(circle(start, 0.06, 0.3, 2.0, 1.0), 1500):
        world.tick(reference)
        if look:
            world.pose_state(reference), world.objects(), world.joint_state()
    return world.qpos()


def test_the_same_seed_and_references_give_the_same_state_to_the_bit() -> None:
    assert np.array_equal(run(make_world(seed=7), False), run(make_world(seed=7), False))


def test_a_reset_world_repeats_itself_to_the_bit() -> None:
    world = make_world(seed=7)
    first = run(world, False)
    world.reset(7)
    assert np.array_equal(first, run(world, False))


def test_looking_at_the_world_does_not_change_it() -> None:
    assert np.array_equal(run(make_world(seed=7), False), run(make_world(seed=7), True))


def test_a_tick_is_one_millisecond_and_a_reset_starts_the_clock_again() -> None:
    world = make_world()
    wait(world, world.hold_reference(), 0.25)
    assert world.time_ns == 250_000_000
    world.reset()
    assert world.time_ns == 0


def test_seeds_place_objects_in_their_regions_and_never_on_each_other() -> None:
    model = make_world().model
    regions, bodies = regions_of(model), objects_of(model)
    reach = sum(footprint_m(model, body) for body in bodies.values())
    places = [draw_places(model, seed) for seed in SEEDS]
    for drawn in places:
        assert drawn.keys() == regions.keys()
        for name, place in drawn.items():
            assert (np.array(place) >= regions[name].low).all()
            assert (np.array(place) <= regions[name].high).all()
        distance = np.hypot(
            drawn["brick"].x_m - drawn["box"].x_m, drawn["brick"].y_m - drawn["box"].y_m
        )
        assert distance > reach
    assert len({drawn["brick"] for drawn in places}) == len(SEEDS)


def test_a_seed_moves_the_objects_and_none_leaves_them_as_the_scene_has_them() -> None:
    world = make_world(seed=3)
    placed = world.objects()["brick"][0]
    world.reset()
    scene = world.objects()["brick"][0]
    assert np.allclose(scene, (0.50, -0.05, 0.0096))
    assert np.linalg.norm(placed - scene) > 0.01
    world.reset(3)
    assert np.array_equal(world.objects()["brick"][0], placed)


def test_a_brick_at_rest_stays_on_the_table() -> None:
    world = make_world(seed=11)
    before = world.objects()["brick"][0]
    wait(world, world.hold_reference(), 1.0)
    after = world.objects()["brick"][0]
    assert np.abs(after - before).max() < TABLE_CLEARANCE_M


def test_an_object_is_put_where_it_is_asked_for() -> None:
    world = make_world()
    world.place("box", (0.45, 0.25, 0.0))
    world.place("brick", (0.4, 0.1, 0.0096), (0.0, 0.0, 1.0, 0.0))
    objects = world.objects()
    assert np.allclose(objects["box"][0], (0.45, 0.25, 0.0))
    assert np.allclose(np.abs(objects["brick"][1]), (0.0, 0.0, 1.0, 0.0))


def test_an_unknown_object_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ResourceError, match="no object 'bottle'; it has: brick, box"):
        make_world().place("bottle", (0.4, 0.0, 0.0))


def test_joints_report_names_position_and_motor_torque() -> None:
    world = make_world()
    wait(world, world.hold_reference(), 0.2)
    state = world.joint_state()
    assert state.names == RobotModel().arm_joints
    assert np.allclose(state.position_rad, HOME_RAD, atol=1e-4)
    assert abs(state.effort_nm[1]) > 5.0  # the shoulder carries the arm
    assert np.abs(state.velocity_rad_s).max() < 1e-3


def test_the_twist_is_the_rate_of_the_pose() -> None:
    world = make_world()
    start = world.hold_reference()
    before, twist = world.tcp()[0], np.zeros(6)
    for reference in itertools.islice(line(start, (0.1, 0.1, 0.1), 1.0), 500):
        before = world.tcp()[0]
        world.tick(reference)
        twist = world.pose_state(reference).twist
    rate = (world.tcp()[0] - before) / 1e-3
    assert np.linalg.norm(rate) > 0.2
    assert np.allclose(twist[:3], rate, atol=TWIST_ATOL_M_S)


def test_the_pose_state_carries_the_reference_it_was_given() -> None:
    world = make_world()
    reference = world.hold_reference()
    state = world.pose_state(reference)
    assert np.allclose(state.position_m, state.reference_position_m, atol=POSE_ATOL)
    assert state.reference_quat_xyzw is not None
    assert abs(state.quat_xyzw @ state.reference_quat_xyzw) == pytest.approx(1.0, abs=POSE_ATOL)
    assert np.allclose(np.abs(state.quat_xyzw), (1.0, 0.0, 0.0, 0.0), atol=1e-6)


def test_a_reference_that_is_not_finite_stops_the_world_with_a_clear_error() -> None:
    world = make_world()
    reference = world.hold_reference()
    broken = PoseReference(np.full(3, np.nan), *reference[1:])
    with pytest.raises(NodeError, match="reference is not finite"):
        world.tick(broken)


def test_a_simulation_that_blows_up_raises_and_can_be_reset() -> None:
    world = make_world()
    reference = world.hold_reference()
    world.place("brick", (0.5, 0.0, 1e12))
    with pytest.raises(NodeError, match=r"diverged after 0\.\d+ s \(badqpos"):
        wait(world, reference, 0.01)
    world.reset()
    wait(world, reference, 0.01)


TWO_BRICKS = """
<mujoco>
  <custom>
    <numeric name="place/blue" data="0.4 0.5 -0.2 0.2 0 0"/>
    <numeric name="place/red" data="0.4 0.5 -0.2 0.2 0 0"/>
  </custom>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="blue" pos="0.4 0.1 0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
    <body name="red" pos="0.4 -0.1 0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
</mujoco>
"""


def test_another_scene_is_only_another_folder(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(TWO_BRICKS)
    world = World(str(tmp_path), [RobotModel()], home_rad=[HOME_RAD], seed=1)
    objects = world.objects()
    assert list(objects) == ["blue", "red"]
    assert np.linalg.norm(objects["blue"][0] - objects["red"][0]) > 0.04 * np.sqrt(2)
    wait(world, world.hold_reference(), 0.1)


def test_a_region_for_an_unknown_object_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(TWO_BRICKS.replace("place/red", "place/green"))
    with pytest.raises(ResourceError, match="places 'green', but can only place: blue, red"):
        World(str(tmp_path), [RobotModel()], home_rad=[HOME_RAD], seed=1)


def test_regions_too_small_for_their_objects_are_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(
        TWO_BRICKS.replace("-0.2 0.2 0 0", "0 0.01 0 0").replace("0.4 0.5", "0.4 0.41")
    )
    with pytest.raises(ResourceError, match="no room for blue, red"):
        World(str(tmp_path), [RobotModel()], home_rad=[HOME_RAD], seed=1)


def test_a_scene_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ResourceError, match="no scene called 'tabel'; did you mean 'table'"):
        World("tabel", [RobotModel()], home_rad=[HOME_RAD])


def test_a_robot_without_the_named_tcp_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ResourceError, match=r"no link 'tool0'; it has: .*panda_hand_tcp"):
        World("table", [RobotModel(tcp_link="tool0")], home_rad=[HOME_RAD])
