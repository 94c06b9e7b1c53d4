"""The simulated SO-101: five joints under joint impedance, a jaw that turns, and its picker."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from vla_zenoh_benchmarks.task_lockstep import run_in_lockstep

from vla_zenoh.lab.tasks.task import DemoPlan
from vla_zenoh.policy import Policy
from vla_zenoh.policy.loader import find_model, import_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_model
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import JointReference

PROFILE = load_profile("so101_sim")
HOME_RAD = np.array(PROFILE.robot.home_rad)
AT_REST_RAD, IN_MOTION_RAD = 1e-3, 0.01
SEEN_M, SEEN_RAD = 2e-3, 0.2


@pytest.fixture
def world() -> World:
    return build_world(PROFILE)


def picker() -> Policy:
    return make_policy(find_model("scripted_pick"))


def test_the_joints_follow_a_motion_and_rest_where_they_were_sent(world: World) -> None:
    goal_rad = np.array([0.6, -0.2, 0.2, 1.2, -0.8])
    far_rad, lag_rad = goal_rad - HOME_RAD, 0.0
    for s in np.linspace(0, 1, 2000):
        share, rate = s**3 * (10 - 15 * s + 6 * s * s), 30 * s**2 * (1 - s) ** 2 / 2
        world.tick(JointReference(HOME_RAD + share * far_rad, rate * far_rad, np.zeros(5)))
        off_rad = world.joint_state().position_rad - HOME_RAD - share * far_rad
        lag_rad = max(lag_rad, np.abs(off_rad).max())
    for _ in range(500):
        world.tick(JointReference.at_rest(goal_rad))
    assert lag_rad < IN_MOTION_RAD
    assert np.abs(world.joint_state().position_rad - goal_rad).max() < AT_REST_RAD
    assert world.saturated == 0


def test_the_jaw_opens_and_shuts_by_its_width(world: World) -> None:
    for width_m in (0.0, 0.05, 0.1):
        world.set_gripper(width_m, 0.1, 10.0)
        for _ in range(1500):
            world.tick(JointReference.at_rest(HOME_RAD))
        state = world.gripper_state()
        assert state.width_m == pytest.approx(width_m, abs=1e-3)
        assert not state.moving
        assert not state.holding


def test_the_picker_sees_where_each_brick_lies() -> None:
    module = import_model(find_model("scripted_pick"))
    world = build_world(PROFILE)
    with Renderer(PROFILE.sim.scene, [robot_model(PROFILE.robot)]) as renderer:
        for seed in range(2):
            world.reset(seed)
            renderer.set_qpos(world.qpos())
            image = renderer.render("front", 640, 480)
            for colour in module.COLOURS:
                seen = module.see_brick(image, colour)
                assert seen is not None
                place_m, (_, _, z, w) = world.objects()[f"{colour}_brick"]
                assert np.linalg.norm(seen[0] - place_m[:2]) < SEEN_M
                turn_rad = seen[1] - 2 * np.arctan2(z, w)
                quarter = np.pi / 2
                off_rad = (turn_rad + quarter / 2) % quarter - quarter / 2
                assert abs(off_rad) < SEEN_RAD


@pytest.mark.parametrize(
    ("prompt", "colour"),
    [
        ("put the red brick in the box", "red"),
        ("  Put the BLUE brick into the box.", "blue"),
        ("do not put the red brick in the box", None),
        ("put the purple brick in the box", None),
        ("hold", None),
    ],
)
def test_the_picker_reads_one_sentence_and_nothing_else(prompt: str, colour: str | None) -> None:
    module = import_model(find_model("scripted_pick"))
    assert module.colour_of(prompt) == colour


def test_the_picker_acts_in_the_five_joints_of_the_arm() -> None:
    action = picker().spec.action
    assert (action.space, action.kind, action.gripper) == ("joint", "absolute", "absolute_m")
    assert action.joints == PROFILE.robot.arm_joints


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 7])
def test_the_picker_puts_a_brick_in_the_box_through_the_command_node(seed: int) -> None:
    colour = ("red", "green")[seed == 7]
    prompt = f"put the {colour} brick in the box"
    plan = DemoPlan("scripted_pick", 1, seed, rate_hz=5.0, prompts=(prompt,))
    ended = [
        outcome for outcome, _ in run_in_lockstep(PROFILE, plan, {}, None, threading.Event(), 1)
    ]
    assert [each.success for each in ended] == [True], ended
