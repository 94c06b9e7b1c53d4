"""Joints as actions of a robot that takes poses: its pose stream keeps the limits of poses.

Every posture from which a pose is hard to reach for the joints, and every way to change one's mind.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_rig import Joints, panda
from panda_arm import HOME_RAD

from vla_zenoh.control.commander import Setting
from vla_zenoh.types import FloatArray

POSTURES = {
    "home": HOME_RAD,
    "wrist singularity": np.array([0.0, -0.3, 0.0, -2.2, 0.0, 0.35, 0.785]),
    "flat wrist": np.array([0.0, 0.1, 0.0, -2.0, 0.0, 0.05, 0.785]),
    "arm stretched": np.array([0.0, 0.35, 0.0, -1.0, 0.0, 1.5, 0.785]),
    "shoulder singularity": np.array([0.0, -1.0, 0.0, -2.9, 0.0, 1.9, 0.785]),
    "elbow out": np.array([0.6, -0.6, -0.7, -2.2, 0.6, 1.8, 0.6]),
    "turned hand": np.array([-0.4, -0.6, 0.3, -2.3, 1.4, 1.3, -1.0]),
}
ROOM = {"workspace": {"x_m": [-0.3, 0.75], "y_m": [-0.6, 0.6], "z_m": [0.02, 0.9]}}
FAMILIES = ("targets", "deltas", "velocities", "reversals", "wrist")


def rows_of(family: str, rng: np.random.Generator, here_rad: FloatArray) -> FloatArray:
    """(n, 7) steps of a chunk."""
    count = int(rng.integers(1, 12))
    if family == "targets":
        return np.tile(here_rad + rng.uniform(-0.8, 0.8, 7), (count, 1))
    if family == "deltas":
        return np.tile(rng.uniform(-0.15, 0.15, 7), (count, 1))
    if family == "velocities":
        return np.tile(rng.uniform(-2.0, 2.0, 7), (count, 1))
    if family == "reversals":
        return rng.uniform(-0.2, 0.2, (count, 7))
    way_rad = np.zeros(7)
    way_rad[[3, 4, 5, 6]] = rng.uniform(-0.2, 0.2, 4)
    return np.tile(way_rad, (count, 1))


KINDS = {"targets": "absolute", "velocities": "velocity"}


@pytest.mark.parametrize(
    ("family", "posture"),
    [(FAMILIES[number % len(FAMILIES)], posture) for number, posture in enumerate(POSTURES)],
)
def test_poses_made_of_joints_keep_the_limits_of_poses(family: str, posture: str) -> None:
    follow_and_judge(family, posture, seed=0, chunks=6)


@pytest.mark.long
@settings(max_examples=40)
@given(
    family=st.sampled_from(FAMILIES),
    posture=st.sampled_from(sorted(POSTURES)),
    seed=st.integers(0, 2**32 - 1),
)
def test_poses_made_of_any_joints_keep_the_limits_of_poses(
    family: str, posture: str, seed: int
) -> None:
    follow_and_judge(family, posture, seed, chunks=8)


def follow_and_judge(family: str, posture: str, seed: int, chunks: int) -> None:
    rng, start_rad = np.random.default_rng(seed), POSTURES[posture]
    arm = Joints(panda("pose", limits=ROOM), kind=KINDS.get(family, "delta"))
    arm.at(start_rad)
    arm.activate()
    for _ in range(chunks):
        arm.send(*rows_of(family, rng, arm.joints_rad))
        arm.run(float(rng.choice([0.02, 0.1, 0.3])))
        if rng.random() < 0.15:
            arm.tick(Setting("speed", float(rng.choice([0.0, 30.0, 100.0]))))
    arm.tick(Setting("speed", 100.0))
    assert arm.rig.state == "active", arm.rig.commander.why
    arm.tick(Setting("active", False))
    arm.rig.settle()
    arm.rig.assert_smooth()


def test_a_tcp_that_is_too_slow_for_its_joints_is_late_says_so_and_arrives() -> None:
    arm, start_rad = Joints(panda("pose", limits=ROOM)), POSTURES["wrist singularity"]
    arm.at(start_rad)
    arm.activate()
    way_rad = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.5, 0.0])
    arm.follow(start_rad + np.linspace(0, 1, 6)[1:, None] * way_rad)
    assert "lead_rad" in arm.hits()
    assert np.linalg.norm(arm.rig.position_m - place_m(arm, start_rad + way_rad)) > 0.01
    arm.settle(start_rad + way_rad)
    assert arm.rig.state == "active"
    assert arm.rig.position_m == pytest.approx(place_m(arm, start_rad + way_rad), abs=1e-6)
    arm.rig.assert_smooth()


def test_a_far_target_is_approached_as_fast_in_poses_as_in_joints() -> None:
    start_rad = POSTURES["elbow out"]
    way_rad = np.array([0.3, 0.0, 0.0, 0.5, 0.0, 0.4, 0.0])
    goal_rad, left_m = start_rad + way_rad, dict[str, float]()
    for command in ("joint", "pose"):
        arm = Joints(panda(command, limits=ROOM))
        arm.at(start_rad)
        arm.activate()
        arm.settle(goal_rad, 1.6)
        assert arm.hits() == {"approach"}
        left_m[command] = float(np.linalg.norm(arm.rig.position_m - place_m(arm, goal_rad)))
        assert left_m[command] > 0.02
        arm.settle(goal_rad, 4.0)
        assert arm.rig.position_m == pytest.approx(place_m(arm, goal_rad), abs=1e-6)
    assert left_m["pose"] == pytest.approx(left_m["joint"], rel=0.25), left_m


def place_m(arm: Joints, joints_rad: FloatArray) -> FloatArray:
    return arm.kinematics.forward(joints_rad).position_m


@pytest.mark.parametrize(("command", "told"), [("pose", True), ("joint", False)])
def test_who_activates_joints_of_a_robot_that_takes_poses_is_told(command: str, told: bool) -> None:
    arm = Joints(panda(command))
    arm.activate()
    assert ("joints_by_pose" in {event.what for event in arm.rig.events}) is told
