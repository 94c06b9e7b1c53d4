"""Joints that turn without an end, in the command node: the shortest way, and never a turn back."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from command_rig import reach_of
from endless_arm import HOME_RAD, endless_arm
from joint_rig import Joints

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.policy_check import chunk_errors
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.meaning import wrapped

HOME = np.array(HOME_RAD)
TURN = 2 * math.pi
EXACT = 1e-5
SELDOM = {"command_hz": 50}
FLANGE = np.array([0, 0, 0, 0, 0, 1.0])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


def turned(arm: Joints) -> float:
    """How far the flange was turned from home, rad, counted."""
    return float(arm.joints_rad[5] - HOME[5])


def steady(arm: Joints) -> bool:
    """Whether no command steps back, or further than its velocity goes."""
    ways = np.diff([command.position_rad[5] for command in arm.joints])
    most = arm.profile.limits.joint.of("velocity_rad_s", 6)[5] * arm.rig.period_ns / 1e9
    return bool((ways > -1e-6).all() and (ways < 1.0001 * most).all())


@pytest.mark.parametrize("said", ["wrapped", "counted"])
def test_targets_are_gone_to_over_many_turns_however_they_are_said(folder: Path, said: str) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM), turns=said)
    arm.activate()
    path = HOME + np.linspace(0, 1.2 * TURN, 110)[:, None] * FLANGE  # past pi twice
    arm.follow(path)
    arm.settle(path[-1])
    assert arm.rig.state == "active", arm.rig.commander.why
    assert turned(arm) == pytest.approx(1.2 * TURN, abs=EXACT)
    assert steady(arm)
    arm.assert_within_limits()


def test_deltas_add_up_over_many_turns(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM), kind="delta")
    arm.activate()
    for _ in range(10):
        arm.send(*[list(0.08 * FLANGE)] * 8)
        arm.run(0.8 - arm.rig.period_ns / 1e9)
    arm.run(1.0)
    assert turned(arm) == pytest.approx(6.4, abs=1e-4)
    assert steady(arm)


def test_a_far_target_is_approached_on_the_shortest_way(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM))
    arm.at(HOME + 5 * TURN * FLANGE)
    arm.activate()
    arm.settle(HOME + (0.6 - TURN) * FLANGE, 3.0)
    assert turned(arm) == pytest.approx(5 * TURN + 0.6, abs=EXACT)


def test_a_way_that_is_told_from_the_start_of_a_chunk_is_the_shortest_too(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM), kind="delta", relative_to="start")
    arm.activate()
    # As of a model that subtracts wrapped positions from each other.
    arm.send(*[list((0.05 * n - TURN) * FLANGE) for n in range(1, 9)])
    arm.run(3.0)
    assert turned(arm) == pytest.approx(0.4, abs=EXACT)
    assert steady(arm)


def test_home_is_at_the_end_of_the_shortest_way(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM))
    arm.at(HOME + (4 * TURN + 0.3) * FLANGE)
    arm.activate()
    arm.settle(HOME, 3.0)
    assert turned(arm) == pytest.approx(4 * TURN, abs=EXACT)


def test_degrees_are_still_recognised(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM))
    arm.activate()
    arm.send(np.rad2deg(HOME))
    arm.run(0.5)
    assert arm.rig.refused["step_rad"] == 1
    assert turned(arm) == pytest.approx(0.0, abs=EXACT)


def test_a_pose_is_turned_to_past_half_a_turn(folder: Path) -> None:
    arm = Joints(
        endless_arm(folder, timing=SELDOM), space="tcp", joints=(), kind="delta", rotation="rotvec"
    )
    reach_of(arm.profile)
    arm.rig.tick(chunks=[arm.rig.chunk([[0.0] * 6])])
    arm.tick(Setting("active", True))
    assert arm.rig.state == "active", arm.rig.commander.why
    axis = arm.kinematics.forward(HOME).rotation @ [1.0, 0.0, 0.0]
    for _ in range(5):
        arm.send(*[[0.0, 0.0, 0.0, *(0.08 * axis)]] * 8)
        arm.run(0.8 - arm.rig.period_ns / 1e9)
    arm.run(1.0)
    assert turned(arm) == pytest.approx(3.2, abs=0.01)
    assert np.abs(arm.joints_rad - HOME)[:5].max() < 0.02
    arm.assert_within_limits()


def test_a_robot_that_begins_to_count_anew_is_not_turned_back(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM))
    arm.at(HOME + 3 * TURN * FLANGE)
    arm.activate()
    arm.settle(HOME, 0.8)
    arm.tick(Setting("active", False))
    arm.run(1.0)
    # Its node was started again: it begins within half a turn, and moves nothing.
    arm.at(wrapped(arm.joints_rad))
    arm.run(1.0)
    arm.joints.clear()
    arm.activate()
    arm.settle(HOME + 0.1 * FLANGE, 1.2)
    first = wrapped(HOME)[5]
    places = [command.position_rad[5] for command in arm.joints]
    assert min(places) > first - EXACT
    assert places[-1] == pytest.approx(first + 0.1, abs=EXACT)


def test_a_count_that_begins_anew_under_an_active_arm_ends_the_activation(folder: Path) -> None:
    arm = Joints(endless_arm(folder, timing=SELDOM))
    arm.at(HOME + 3 * TURN * FLANGE)
    arm.activate()
    arm.settle(HOME, 0.8)
    commanded = arm.joints[-1].position_rad[5]
    arm.rig.blocked = True  # nothing of ours moves it: its guard rejects a jump
    arm.at(wrapped(arm.joints_rad))
    arm.run(1.0)
    assert arm.rig.state == "inactive"
    assert any("elbow_rad" in event.what for event in arm.rig.events)
    assert abs(arm.joints[-1].position_rad[5] - commanded) < 0.01


def test_numbers_of_many_turns_are_a_matter_of_the_declaration() -> None:
    names = tuple(f"joint{n}" for n in range(1, 7))
    wrapping = ActionSpec(
        horizon=1, dt_s=0.1, kind="absolute", space="joint", joints=names, gripper="none"
    )
    from vla_zenoh.profile import load_profile

    limits = load_profile("panda_sim").limits
    steps = np.array([[0, 0, 0, 0, 0, 20.0]], np.float32)
    assert list(chunk_errors(wrapping, steps, limits, 0.08))
    counting = wrapping.model_copy(update={"turns": "counted"})
    assert not list(chunk_errors(counting, steps, limits, 0.08))
