"""Actions in joint space: what a policy asks of the joints is what the joints do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from command_rig import WORKER, model_spec
from joint_rig import Joints, panda
from other_arms import so101
from panda_arm import ARM_JOINTS, HOME_RAD, swivelled

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.limits import BEGIN_JOINT, workspace_corners
from vla_zenoh.types import FloatArray, JointState, Stamped

EXACT_RAD = 1e-6


def test_absolute_joints_are_reached_exactly() -> None:
    arm = Joints()
    arm.activate()
    goal_rad = HOME_RAD + [0.3, 0.1, -0.3, 0.1, 0.2, 0.1, -0.4]
    arm.follow(HOME_RAD + np.linspace(0, 1, 16)[1:, None] * (goal_rad - HOME_RAD))
    arm.settle(goal_rad)
    assert arm.rig.state == "active"
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD


@pytest.mark.parametrize("kind", ["absolute", "delta"])
def test_no_limit_is_broken_whatever_the_policy_asks(kind: str) -> None:
    rng, arm = np.random.default_rng(0), Joints(kind=kind)
    arm.activate()
    for _ in range(8):
        rows = (HOME_RAD + rng.uniform(-1.2, 1.2, (1, 7))) * np.ones((8, 1))
        if kind == "delta":
            rows = rng.uniform(-0.15, 0.15, (1, 7)) * np.ones((8, 1))
        arm.send(*rows)
        arm.run(float(rng.choice([0.05, 0.2, 0.5])))
    arm.tick(Setting("active", False))
    arm.run(1.2)
    assert arm.rig.commander.at_rest
    arm.assert_within_limits()


def test_columns_are_mapped_by_the_names_of_the_joints() -> None:
    arm = Joints(names=ARM_JOINTS[::-1])
    arm.activate()
    goal_rad = HOME_RAD + [0.1, 0.05, -0.1, 0.05, 0.1, 0.05, -0.1]
    arm.settle(goal_rad)
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD


def test_a_worker_with_other_joints_is_rejected_by_their_names() -> None:
    arm = Joints(names=("elbow", *ARM_JOINTS[1:]))
    arm.send(HOME_RAD)
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert "its joints are elbow, panda_joint2" in arm.rig.commander.why


def test_a_robot_that_takes_poses_gets_those_of_the_joints() -> None:
    arm = Joints(panda("pose"))
    arm.activate()
    goal_rad = HOME_RAD + [0.2, 0.05, -0.2, 0.05, 0.1, 0.05, -0.2]
    goal = arm.kinematics.forward(goal_rad)
    arm.settle(goal_rad)
    assert np.abs(arm.rig.position_m - goal.position_m).max() < EXACT_RAD
    arm.rig.assert_smooth()


def test_an_elbow_swivels_as_asked_with_the_tcp_at_rest() -> None:
    arm = Joints()
    goal_rad = swivelled(arm.kinematics, 0.9)
    assert np.abs(goal_rad - HOME_RAD).max() > 0.4
    arm.activate()
    arm.go(goal_rad, 2.5)
    assert np.abs(arm.joints_rad - goal_rad).max() < EXACT_RAD
    arm.assert_within_limits()


@pytest.mark.long
def test_fifty_random_smooth_motions_end_where_they_were_asked_to() -> None:
    rng, arm = np.random.default_rng(1), Joints()
    arm.activate()
    errors: list[float] = []
    while len(errors) < 50:
        goal_rad = HOME_RAD + rng.uniform(-0.4, 0.4, 7)
        if not arm.is_free(goal_rad):
            continue
        arm.go(goal_rad, float(rng.uniform(2.0, 3.0)))
        errors.append(float(np.abs(arm.joints_rad - goal_rad).max()))
    assert max(errors) < 1e-3, (errors, arm.hits())
    arm.assert_within_limits()


@pytest.mark.parametrize("rate_hz", [2.5, 15.0])
def test_joint_deltas_are_carried_out_whole_however_often_the_model_is_asked(
    rate_hz: float,
) -> None:
    """DROID: steps of 1/15 s, each added to the last."""
    arm = Joints(kind="delta", dt_s=1 / 15)
    arm.activate()
    step_rad = np.array([0.02, 0.0, 0.0, 0.012, 0.0, 0.008, 0.0])
    first_ns = last_ns = 0
    for _ in range(round(0.8 * rate_hz)):
        first_ns = first_ns or arm.rig.now_ns
        last_ns = arm.rig.now_ns
        arm.send(*[step_rad] * 8)
        arm.run(1 / rate_hz - arm.rig.period_ns / 1e9)
    arm.run(1.5)
    steps = (last_ns - first_ns) / 1e9 * 15 + 8  # the last chunk runs on to its end
    covered = (arm.joints_rad - HOME_RAD)[step_rad > 0] / (steps * step_rad[step_rad > 0])
    assert (covered > 0.98).all(), covered
    assert (covered < 1.02).all(), covered


def test_deltas_of_a_chunk_may_all_be_relative_to_its_start() -> None:
    arm = Joints(kind="delta", relative_to="start")
    arm.activate()
    arm.send(*([0.02 * n, 0, 0, 0, 0, 0, 0] for n in range(1, 6)))
    arm.run(2.0)
    assert arm.joints_rad - HOME_RAD == pytest.approx([0.1, 0, 0, 0, 0, 0, 0], abs=EXACT_RAD)


def test_velocities_of_the_joints_last_as_long_as_their_steps() -> None:
    arm = Joints(kind="velocity")
    arm.activate()
    arm.send(*[[0, 0, 0, 0.2, 0, 0, 0]] * 5)
    arm.run(2.0)
    assert arm.joints_rad - HOME_RAD == pytest.approx([0, 0, 0, 0.1, 0, 0, 0], abs=EXACT_RAD)


def test_a_chunk_anchored_at_the_measured_joints_begins_where_they_were_observed() -> None:
    arm = Joints(kind="delta", anchor="measured", relative_to="start")
    arm.activate()
    arm.send(*[[0.1, 0, 0, 0, 0, 0, 0]] * 5)
    arm.run(0.3)  # it moves
    seen_rad = arm.joints_rad.copy()
    assert 0.005 < seen_rad[0] < 0.095
    arm.run(0.1)
    arm.send(*[[0, 0.05, 0, 0, 0, 0, 0]] * 5, observed_ago_s=0.1)
    arm.run(2.0)
    assert arm.joints_rad - seen_rad == pytest.approx([0, 0.05, 0, 0, 0, 0, 0], abs=2e-3)


# -- bounds ---------------------------------------------------------------------------------------
def test_a_goal_beyond_a_joint_s_range_ends_at_its_margin_and_is_told() -> None:
    arm = Joints()
    margin_rad = arm.profile.limits.reach.joint_margin_rad
    near_rad, end_rad = HOME_RAD.copy(), HOME_RAD.copy()
    near_rad[6] = arm.kinematics.upper_rad[6] - margin_rad - 0.2
    end_rad[6] = arm.kinematics.upper_rad[6] + 0.2
    arm.at(near_rad)
    arm.activate()
    arm.settle(end_rad)
    assert arm.rig.state == "active", arm.rig.commander.why
    assert arm.joints_rad[6] == pytest.approx(arm.kinematics.upper_rad[6] - margin_rad, abs=1e-6)
    assert "joint_limit" in arm.hits()
    arm.settle(near_rad)
    assert arm.joints_rad == pytest.approx(near_rad, abs=EXACT_RAD)


def test_an_arm_that_begins_within_the_margin_of_a_range_only_leaves_it() -> None:
    arm = Joints()
    near_rad = HOME_RAD.copy()
    near_rad[6] = arm.kinematics.upper_rad[6] - 0.03
    arm.at(near_rad)
    arm.activate()
    nearer_rad = near_rad + [0, 0, 0, 0, 0, 0, 0.02]
    arm.settle(nearer_rad, 1.0)
    assert arm.rig.state == "active", arm.rig.commander.why
    assert arm.joints_rad == pytest.approx(near_rad, abs=EXACT_RAD)
    assert "joint_limit" in arm.hits()
    away_rad = near_rad - [0, 0, 0, 0, 0, 0, 0.3]
    arm.settle(away_rad)
    assert arm.joints_rad == pytest.approx(away_rad, abs=EXACT_RAD)


@pytest.mark.long
def test_joints_slide_along_the_workspace_box_and_are_told() -> None:
    arm = Joints()
    arm.activate()
    low_rad = HOME_RAD + [0.3, 0.45, 0, 0, 0, 0, 0]  # below the table, and to the side
    arm.settle(low_rad, 4.0)
    assert arm.rig.state == "active", arm.rig.commander.why
    assert "workspace" in arm.hits()
    place = arm.kinematics.forward(arm.joints_rad).position_m
    assert place[2] < arm.profile.limits.workspace.z_m[0] + 0.01
    assert arm.joints_rad[0] > 0.15
    arm.assert_within_limits()
    arm.settle(HOME_RAD, 4.0)
    assert arm.joints_rad == pytest.approx(HOME_RAD, abs=EXACT_RAD)


def test_an_arm_slows_down_and_ends_before_it_touches_itself() -> None:
    limits = {"workspace": {"x_m": [-0.6, 0.75], "z_m": [0.012, 0.9]}}
    arm = Joints(panda(limits=limits))
    arm.activate()
    folded_rad = np.array([0.0, -0.6, 0.0, -3.0, 0.0, 0.2, 0.785])
    arm.settle(folded_rad, 8.0)
    assert arm.hits() & {"self_collision", "self"}, arm.hits()
    arm.assert_within_limits()


POST = {"centre_m": [0.3, 0.35, 0.3], "box_m": [0.1, 0.1, 0.8]}


def test_joints_slow_down_and_end_before_a_link_enters_what_it_keeps_out_of() -> None:
    arm = Joints(panda(limits={"reach": {"keep_out": {"post": POST}}}))
    arm.activate()
    behind_rad = HOME_RAD + [1.3, 0, 0, 0, 0, 0, 0]  # the post is on the way there
    arm.settle(behind_rad, 6.0)
    assert arm.rig.state == "active", arm.rig.commander.why
    assert "keep_out" in arm.hits()
    assert 0.1 < arm.joints_rad[0] < 0.8
    arm.assert_within_limits()
    arm.settle(HOME_RAD, 6.0)
    assert arm.joints_rad == pytest.approx(HOME_RAD, abs=EXACT_RAD)


# -- five joints ----------------------------------------------------------------------------------
@pytest.mark.long
def test_an_arm_of_five_joints_follows_twenty_five_motions_of_its_joints() -> None:
    rng, arm = np.random.default_rng(2), Joints(so101())
    arm.activate()
    errors: list[float] = []
    while len(errors) < 25:
        goal_rad = arm.home_rad + rng.uniform(-0.7, 0.7, 5)
        if not arm.is_free(goal_rad):
            continue
        arm.go(goal_rad, float(rng.choice([1.5, 2.5])))
        errors.append(float(np.abs(arm.joints_rad - goal_rad).max()))
    assert arm.rig.state == "active", arm.rig.commander.why
    assert max(errors) < 1e-3, (errors, arm.hits())


@pytest.mark.parametrize(
    ("action", "why"),
    [
        ({"space": "tcp", "joints": (), "rotation": "rotvec"}, "5 arm joints"),
        ({}, "its robot takes poses"),
    ],
)
def test_what_five_joints_cannot_do_is_rejected_by_name(action: dict[str, Any], why: str) -> None:
    command = "joint" if action else "pose"
    arm = Joints(so101(command), **action)
    arm.send([0.0] * arm.rig.spec.action.dimension)
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert why in arm.rig.commander.why


def test_a_turn_that_five_joints_cannot_make_is_a_reason_against_an_activation() -> None:
    arm = Joints(so101(), space="tcp", joints=(), kind="delta", rotation="rotvec")
    arm.send([0.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert "that the 5 joints of robot 'so101' cannot make from here: yaw" in arm.rig.commander.why


@pytest.mark.parametrize("mode", ["replace", "ensemble"])
def test_the_goal_stays_inside_the_box_when_the_leash_cuts_it_or_plans_are_averaged(
    mode: str,
) -> None:
    arm = Joints(panda(composition={"mode": mode}), kind="delta")
    low, high = workspace_corners(arm.profile.limits)
    rng, worst_m = np.random.default_rng(3), 0.0
    arm.activate()
    for _ in range(14):
        arm.send(*(rng.uniform(-0.3, 0.3, (1, 7)) * np.ones((8, 1))))
        for _ in range(40):
            arm.tick()
            goal = arm.rig.commander.parts[0].motion.goal
            if goal is not None:
                at_m = goal.pose.position_m
                worst_m = max(worst_m, float(np.abs(at_m - np.clip(at_m, low, high)).max()))
    assert arm.rig.state == "active", arm.rig.commander.why
    assert worst_m < 1e-4
    arm.assert_within_limits()


@pytest.mark.parametrize("relative_to", ["start", "previous"])
def test_a_joint_worker_that_takes_over_from_poses_moves_as_far_as_it_asks(
    relative_to: str,
) -> None:
    arm = Joints(panda(), kind="delta", relative_to=relative_to)
    poses = model_spec("poses", gripper="none")
    peers = arm.rig.peers
    alive = peers.alive | {"worker-poses"}
    arm.rig.peers = replace(
        peers,
        alive=alive,
        same_host=alive,
        specs={**peers.specs, "poses": poses},
        spec_sources={**peers.spec_sources, "poses": "worker-poses-1"},
    )

    def rest() -> None:
        arm.tick(chunks=[arm.rig.chunk([[0.0] * 6], worker="poses", spec_hash=poses.hash)])

    rest()
    arm.tick(Setting("worker", "poses"))
    rest()
    arm.tick(Setting("active", True))
    assert arm.rig.state == "active", arm.rig.commander.why
    rest()
    arm.run(0.2)
    arm.send([0.0] * 7)
    arm.tick(Setting("worker", WORKER))
    assert arm.rig.commander.task.worker == WORKER, arm.rig.commander.why
    arm.run(0.1)
    start_rad = arm.joints_rad.copy()
    swivel = np.linalg.svd(arm.kinematics.jacobian(start_rad))[2][-1]
    counts = range(1, 17) if relative_to == "start" else [1] * 16
    arm.send(*(0.06 * count * swivel for count in counts))
    arm.run(2.5)
    np.testing.assert_allclose(arm.joints_rad, start_rad + 0.96 * swivel, atol=1e-4)


def test_joints_that_brake_go_on_without_a_step_where_their_controller_lags_at_an_activation() -> (
    None
):
    arm = Joints(panda(), space="tcp", joints=(), kind="delta", rotation="rotvec")
    told, held = arm.rig.joint_state, list[FloatArray]()

    def late() -> Stamped[JointState]:
        state = told()
        held.append(state.record.position_rad)
        record = replace(state.record, reference_rad=held[max(len(held) - 3, 0)])
        return replace(state, record=record)

    def activate() -> None:
        arm.send([0.0] * 6)
        arm.tick(Setting("active", True))
        assert arm.rig.state == "active", arm.rig.commander.why

    arm.rig.joint_state = late
    activate()
    for _ in range(6):
        arm.send([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
        arm.run(0.09)
    arm.tick(Setting("active", False))
    arm.run(0.04)
    assert np.abs(held[-1] - held[-3]).max() > 2 * BEGIN_JOINT.turns
    activate()
    arm.run(0.5)
    arm.assert_within_limits()


@pytest.mark.parametrize("command", ["joint", "pose"])
@pytest.mark.parametrize("how", ["renamed", "fewer"])
def test_joints_of_another_arm_end_the_activation(command: str, how: str) -> None:
    arm = Joints(panda(command))
    arm.activate()
    arm.run(0.3)
    told = arm.rig.joint_state

    def other() -> Stamped[JointState]:
        state = told()
        record = state.record
        names, count = [*record.names[:-1], "other"], len(record.names)
        if how == "fewer":
            names, count = names[:-1], count - 1
        zeros = np.zeros(count)
        given = JointState(tuple(names), record.position_rad[:count], zeros, zeros)
        return replace(state, record=given)

    arm.rig.joint_state = other
    for _ in range(20):
        arm.tick()
    assert arm.rig.state == "inactive"
    assert "wanted once each" in arm.rig.commander.why


def test_targets_in_degrees_are_rejected_with_the_joint_and_its_range() -> None:
    arm = Joints(so101())
    arm.activate()
    start_rad = arm.joints_rad.copy()
    arm.send(*[arm.columns(np.array([5.0, -9.0, 11.0, 4.0, 2.0]))] * 8)
    arm.run(1.0)
    assert arm.rig.refused == {"joint_limit": 1}
    assert any("are these radians" in event.why for event in arm.rig.events)
    np.testing.assert_allclose(arm.joints_rad, start_rad, atol=1e-6)


DEGREES = np.array([5.0, -9.0, 11.0, 4.0, 2.0])
ELBOW = np.array([0.0, 0.0, 11.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("action", "row", "why"),
    [
        ({}, DEGREES, "not sane: joint_limit: a target of elbow_flex at 11 rad"),
        ({}, 57.0 * DEGREES, "not sane: joint_units: a target of a joint of 627 rad"),
        ({"kind": "delta"}, DEGREES, "not sane: joint_units: a step of a joint of 11 rad"),
        ({"kind": "delta"}, ELBOW, "not sane: joint_units: a step of a joint of 11 rad"),
        ({"kind": "velocity"}, 5 * DEGREES, "not sane: joint_units: a step of a joint of 5.5 rad"),
        (
            {"kind": "delta", "relative_to": "start"},
            DEGREES,
            "not sane: joint_limit: a target of elbow_flex at 11.6 rad",
        ),
    ],
)
def test_joints_that_cannot_be_radians_are_a_reason_against_an_activation(
    action: dict[str, Any], row: FloatArray, why: str
) -> None:
    arm = Joints(so101(), **action)
    arm.send(row)
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert why in arm.rig.commander.why
