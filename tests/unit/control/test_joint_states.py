"""Joint actions and the states of the command node: stop, watchdog, override, handover, mixing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from command_rig import OTHER, model_spec
from joint_rig import Joints, panda
from panda_arm import ARM_JOINTS, HOME_RAD

from vla_zenoh.control.commander import Setting
from vla_zenoh.types import PoseState, Stamped

SIDEWAYS_RAD = np.array([0.5, 0.0, -0.2, 0.0, 0.2, 0.0, 0.0])
TCP = {"rotation": "rotvec", "gripper": "none"}
OF_JOINTS = {"space": "joint", "joints": ARM_JOINTS, "kind": "absolute", "gripper": "none"}


def moving(of: Any = None, **action: Any) -> Joints:
    """An arm on its way, 0.5 s after it was asked to go sideways."""
    arm = Joints(of, **action)
    arm.activate()
    arm.send(*(HOME_RAD + SIDEWAYS_RAD * n / 16 for n in range(1, 17)))
    arm.run(0.5)
    assert fastest(arm) > 0.1
    return arm


def fastest(arm: Joints) -> float:
    return float(np.abs(arm.joints[-1].velocity_rad_s).max())


def assert_stopped(arm: Joints) -> None:
    rest_rad = arm.joints_rad.copy()
    assert arm.rig.commander.at_rest
    arm.run(0.2)
    assert arm.joints_rad == pytest.approx(rest_rad, abs=1e-9)
    arm.assert_within_limits()


def test_a_stop_brakes_the_joints_within_their_limits_and_latches() -> None:
    arm = moving()
    arm.tick("stop")
    arm.run(0.6)
    assert_stopped(arm)
    assert arm.rig.state == "stopped"
    arm.tick(Setting("active", True))
    assert arm.rig.state == "stopped"
    arm.tick(Setting("reset"))
    arm.activate()
    arm.settle(HOME_RAD)
    assert arm.joints_rad == pytest.approx(HOME_RAD, abs=1e-6)


def test_joints_hold_when_no_chunk_comes_and_go_on_with_the_next_one() -> None:
    arm = moving()
    arm.run(2.2)
    assert arm.rig.state == "holding"
    assert_stopped(arm)
    arm.settle(HOME_RAD + SIDEWAYS_RAD)
    assert arm.rig.state == "active"
    assert arm.joints_rad == pytest.approx(HOME_RAD + SIDEWAYS_RAD, abs=1e-6)


def test_a_speed_override_slows_the_joints_down_and_pauses_them() -> None:
    arm = moving()
    full = fastest(arm)
    arm.tick(Setting("speed", 20.0))
    arm.run(0.4)
    assert fastest(arm) < 0.25 * full
    arm.tick(Setting("speed", 0.0))
    arm.run(0.4)
    assert_stopped(arm)
    arm.tick(Setting("speed", 100.0))
    arm.settle(HOME_RAD + SIDEWAYS_RAD)
    assert arm.joints_rad == pytest.approx(HOME_RAD + SIDEWAYS_RAD, abs=1e-6)
    arm.assert_within_limits()


@pytest.mark.parametrize("mode", ["blend", "ensemble"])
def test_overlapping_chunks_of_joints_are_mixed_in_joints(mode: str) -> None:
    arm = Joints(panda(composition={"mode": mode}))
    arm.activate()
    goal_rad = HOME_RAD + SIDEWAYS_RAD
    arm.follow(HOME_RAD + np.linspace(0, 1, 17)[1:, None] * SIDEWAYS_RAD)
    arm.settle(goal_rad)
    assert arm.joints_rad == pytest.approx(goal_rad, abs=1e-6)
    arm.assert_within_limits()


def test_a_blocked_arm_is_led_back_after_a_joint_action() -> None:
    arm = moving()
    at_m, joints_rad = arm.rig.position_m.copy(), arm.joints_rad.copy()
    arm.rig.blocked = True
    for n in range(8):
        arm.send(*(HOME_RAD + SIDEWAYS_RAD * (n / 2 + k) / 4 for k in range(1, 9)))
        arm.run(0.1)
        if arm.rig.state != "active":
            break
    assert arm.rig.state == "inactive"
    arm.run(2.5)
    assert "retreat" in {event.what for event in arm.rig.events}
    assert np.linalg.norm(arm.places_m[-1] - at_m) < 0.025
    assert joints_rad == pytest.approx(arm.joints_rad)
    assert not arm.rig.commander.streaming


def test_a_load_on_the_tcp_ends_a_joint_motion() -> None:
    arm = moving()
    plain = arm.rig.pose_state

    def loaded() -> Stamped[PoseState]:
        said = plain()
        wrench = np.array([0.0, -60.0, 0.0, 0.0, 0.0, 0.0])
        return replace(said, record=replace(said.record, wrench=wrench))

    arm.rig.pose_state = loaded  # type: ignore[method-assign]
    arm.run(1.5)
    assert arm.rig.state == "inactive"
    assert "presses against the arm" in arm.rig.commander.why
    assert "contact_force" in arm.hits()
    arm.run(2.0)
    assert arm.rig.commander.at_rest


# -- from one space to the other ------------------------------------------------------------------
@pytest.mark.parametrize("command", ["joint", "pose"])
def test_a_tcp_worker_takes_over_from_moving_joints_within_the_limits(
    command: str,
) -> None:
    arm = moving_of(command, OF_JOINTS, TCP)
    arm.send(*(HOME_RAD + SIDEWAYS_RAD * n / 16 for n in range(1, 17)))
    arm.run(0.5)
    arm.send([0.0] * 6, worker=OTHER, spec_hash=arm.rig.peers.specs[OTHER].hash)
    arm.tick(Setting("worker", OTHER))
    assert arm.rig.commander.task.worker == OTHER
    begun = len(arm.places_m)
    for _ in range(8):
        step = [0.007, 0, 0, 0, 0, 0]
        arm.send(*[step] * 3, worker=OTHER, spec_hash=arm.rig.peers.specs[OTHER].hash)
        arm.run(0.3)
    arm.run(1.0)
    moved_m = arm.places_m[-1] - arm.places_m[begun + 150]
    assert moved_m[0] > 0.05
    arm.assert_tcp_within()


@pytest.mark.parametrize("command", ["joint", "pose"])
def test_a_joint_worker_takes_over_from_a_moving_tcp_and_ends_where_it_asks(
    command: str,
) -> None:
    arm = moving_of(command, TCP, OF_JOINTS)
    arm.send(*[[0.01, 0.01, 0, 0, 0, 0.02]] * 16)
    arm.run(0.5)
    arm.names = ARM_JOINTS
    other = {"worker": OTHER, "spec_hash": arm.rig.peers.specs[OTHER].hash}
    arm.send(HOME_RAD, **other)
    arm.tick(Setting("worker", OTHER))
    assert arm.rig.commander.task.worker == OTHER
    goal_rad = HOME_RAD + SIDEWAYS_RAD / 2
    for _ in range(8):
        arm.send(*[goal_rad] * 8, **other)
        arm.run(0.3)
    if command == "joint":
        assert arm.joints_rad == pytest.approx(goal_rad, abs=1e-6)
    goal_m = arm.kinematics.forward(goal_rad).position_m
    assert arm.places_m[-1] == pytest.approx(goal_m, abs=1e-6)
    arm.assert_tcp_within()


def moving_of(command: str, action: dict[str, Any], other: dict[str, Any]) -> Joints:
    """An active arm with a worker of each space."""
    fields = {"space": "tcp", "joints": (), "kind": "delta", **action}
    arm = Joints(panda(command), **fields)
    spec = model_spec(**other)
    arm.rig.peers = replace(arm.rig.peers, specs={**arm.rig.peers.specs, OTHER: spec})
    if action is TCP:
        arm.send([0.0] * 6)
        arm.tick(Setting("active", True))
        assert arm.rig.state == "active", arm.rig.commander.why
    else:
        arm.activate()
    return arm
