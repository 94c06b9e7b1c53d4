"""What an option says of numbers holds for answers, for steps in execution and for the state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_policy_servers.action_semantics import ActionSemantics, read_action_semantics
from vla_zenoh_policy_servers.state_vector import (
    CUT,
    ROTATIONS,
    home_reference,
    read_parts,
    state_numbers,
)

from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.kinematics import home_orientation
from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation, rotation_from_quat
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.meaning import ROTATION_FORMS
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, JointState, PoseState

SO101 = load_profile("so101_sim")
PANDA = load_profile("panda_sim")
DEGREES = {"action": "joint_position", "joint_scale_rad": "0.0174533"}
ATOL = 1e-9
NOISE_RAD = 1e-4

ADDED = {"anchor": "goal", "relative_to": "previous", "controller": "none"}
ARMS: Mapping[str, Mapping[str, str]] = {
    **{
        f"{kind} {rotation}": {"action": kind, "rotation": rotation, **added}
        for rotation in ROTATIONS
        for kind, added in (("absolute", {}), ("delta", ADDED))
    },
    "velocity": {"action": "velocity", "rotation": "rotvec", "anchor": "goal"},
    "delta of a controller": {
        "action": "delta",
        "rotation": "rotvec",
        "controller": "150:1",
        "position_scale_m": "0.05",
        "rotation_scale_rad": "0.5",
        "clip": "1",
    },
    "pose in mm and degrees": {
        "action": "absolute",
        "rotation": "rpy",
        "position_scale_m": "0.001",
        "rotation_scale_rad": "0.0174533",
    },
    "degrees": DEGREES,
    "degrees from another zero": {**DEGREES, "joint_zero": "90"},
    "one unit each": {
        "action": "joint_position",
        "joint_scale_rad": "1,-1,0.0174533,-0.0174533,0.2",
        "joint_zero": "0,0,5,-90,0",
    },
    "joint deltas": {"action": "joint_delta", "joint_scale_rad": "0.2", **ADDED},
    "joint velocities": {"action": "joint_velocity", "joint_scale_rad": "-0.5", "anchor": "goal"},
}
GRIPPERS: Mapping[str, Mapping[str, str]] = {
    "none": {"gripper": "none"},
    "delta": {"gripper": "delta_m"},
    "width": {"gripper": "absolute_m"},
    "open": {"gripper": "open_fraction", "gripper_open": "high"},
    "closed": {"gripper": "open_fraction", "gripper_open": "low"},
    "percent": {"gripper": "open_fraction", "gripper_range": "0:100"},
    "percent closed": {"gripper": "open_fraction", "gripper_range": "100:0"},
    "rad": {"gripper": "open_fraction", "gripper_range": "1.0:-0.5"},
    "binary": {"gripper": "binary", "gripper_open": "low", "gripper_threshold": "0"},
}
REST = {"dt_s": "0.1", "horizon": "8"}


def meaning(arm: str, gripper: str) -> ActionSemantics:
    told = {**ARMS[arm], **GRIPPERS[gripper], **REST}
    return read_action_semantics(told, joints=SO101.robot.arm_joints)


@pytest.mark.parametrize("gripper", GRIPPERS)
@pytest.mark.parametrize("arm", ARMS)
def test_rows_are_the_inverse_of_steps(arm: str, gripper: str) -> None:
    told = meaning(arm, gripper)
    random = np.random.default_rng(7)
    rows = random.uniform(-1.0, 1.0, (6, sum(told.parts().values())))
    if not told.needs_joints and told.rotation not in ("rpy", "rotvec"):
        form = ROTATION_FORMS[told.rotation]
        quats = [exp3(random.uniform(-1.7, 1.7, 3)) for _ in rows]
        for row, rotation in zip(rows, quats, strict=True):
            quat = random.choice([-1.0, 1.0]) * quat_from_rotation(rotation)
            row[3 : 3 + form.size] = form.encode(quat, quat)
    steps = told.steps(rows)
    assert steps.shape[1] == told.spec.dimension
    np.testing.assert_allclose(told.rows(steps), rows, atol=ATOL)
    np.testing.assert_allclose(told.steps(told.rows(steps)), steps, atol=ATOL)


# -- the state ------------------------------------------------------------------------------------
def seen(profile: Any = SO101, **state: Any) -> Observation:
    names, home_rad = profile.robot.arm_joints, np.array(profile.robot.home_rad)
    parts = ("joint", "pose", "gripper")
    spec = ModelSpec(
        name="all",
        observation=ObservationSpec(state=parts),
        action=ActionSpec(horizon=1, dt_s=0.1),
    )
    zeros = np.zeros(len(names))
    known = {
        "joint": JointState(names, home_rad, zeros, zeros),
        "pose": PoseState(
            np.array([0.3, 0.1, 0.2]), np.array(home_orientation(profile)), np.zeros(6)
        ),
        "gripper": GripperState(0.03, moving=False, holding=False),
    }
    return replace(example_observation(spec), **{**known, **state})


@pytest.mark.parametrize("gripper", ["open", "closed", "percent", "percent closed", "rad"])
def test_a_joint_policy_that_answers_its_own_state_asks_the_arm_to_stay(gripper: str) -> None:
    """Joints and gripper, in whatever units: as an SO-101's in degrees and percent."""
    part = "gripper_closed" if gripper == "closed" else "gripper_open"
    for arm in ("degrees", "degrees from another zero", "one unit each"):
        told = meaning(arm, gripper)
        state = state_numbers(read_parts(f"joint+{part}"), SO101, told.state_units)
        observation = seen()
        (step,) = told.steps(state.encode(observation)[None].astype(float))
        np.testing.assert_allclose(step[:5], SO101.robot.home_rad, atol=1e-6)
        share = told.spec.gripper_scale(SO101.robot.gripper.max_width_m).decode(step[-1])
        assert share * SO101.robot.gripper.max_width_m == pytest.approx(0.03, abs=1e-6)


def test_the_documented_so_101_is_told_percent_in_the_state_too() -> None:
    told = meaning("degrees", "percent")
    state = state_numbers(read_parts("joint_deg+gripper_open"), SO101, told.state_units)
    wide = seen(gripper=GripperState(SO101.robot.gripper.max_width_m, False, False))
    assert state.encode(wide)[-1] == pytest.approx(100.0)
    np.testing.assert_allclose(state.encode(wide)[:5], np.rad2deg(SO101.robot.home_rad), rtol=1e-6)


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_a_pose_policy_that_answers_its_own_state_asks_the_arm_to_stay(rotation: str) -> None:
    told = meaning(f"absolute {rotation}", "width")
    state = state_numbers(read_parts(f"position+{rotation}+gripper_m"), PANDA, told.state_units)
    (step,) = told.steps(state.encode(seen(PANDA)).astype(float)[None])
    np.testing.assert_allclose(step[:3], [0.3, 0.1, 0.2], atol=1e-6)
    there = rotation_from_quat(np.array(told.spec.rotation_form.decode(step[3:-1])))
    wanted = rotation_from_quat(np.array(home_orientation(PANDA)))
    np.testing.assert_allclose(there, wanted, atol=1e-5)
    assert step[-1] == pytest.approx(0.03)


def test_units_of_absolute_poses_are_those_of_the_state() -> None:
    told = meaning("pose in mm and degrees", "width")
    turned = PoseState(
        np.array([0.3, 0.1, 0.2]), quat_from_rotation(exp3(np.array([0, 0, 0.5]))), np.zeros(6)
    )
    state = state_numbers(read_parts("position+rpy"), PANDA, told.state_units)
    numbers = state.encode(seen(PANDA, pose=turned))
    np.testing.assert_allclose(numbers[:3], [300, 100, 200], rtol=1e-6)
    assert numbers[5] == pytest.approx(math.degrees(0.5), rel=1e-5)
    delta = meaning("delta of a controller", "width")
    state = state_numbers(read_parts("position"), PANDA, delta.state_units)
    np.testing.assert_allclose(state.encode(seen(PANDA)), [0.3, 0.1, 0.2], rtol=1e-6)


@given(
    rotvec=st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3),
    width=st.floats(0, 0.1),
    turn=st.sampled_from(ROTATIONS),
    grip=st.sampled_from(["gripper_m", "fingers_m", "gripper_open"]),
    arm=st.sampled_from(["degrees", "one unit each", "pose in mm and degrees", "velocity"]),
    gripper=st.sampled_from(["width", "percent", "rad", "binary"]),
)
def test_a_state_in_any_units_is_read_back(
    rotvec: list[float], width: float, turn: str, grip: str, arm: str, gripper: str
) -> None:
    units = meaning(arm, gripper).state_units
    state = state_numbers(read_parts(f"joint+position+{turn}+zero+{grip}"), SO101, units)
    quat = quat_from_rotation(exp3(np.array(rotvec)))
    observation = seen(
        pose=PoseState(np.array([0.3, -0.1, 0.2]), quat, np.zeros(6)),
        gripper=GripperState(width, moving=False, holding=False),
    )
    back = state.decode(state.encode(observation).astype(float))
    np.testing.assert_allclose(back["joint"], SO101.robot.home_rad, atol=1e-5)
    np.testing.assert_allclose(back["position_m"], [0.3, -0.1, 0.2], atol=1e-6)
    assert abs(back["quat_xyzw"] @ quat) == pytest.approx(1.0, abs=1e-5)
    assert back["width_m"] == pytest.approx(width, abs=1e-6)


# -- the reference of rotations -------------------------------------------------------------------
@pytest.mark.parametrize("turn", CUT)
@pytest.mark.parametrize("profile", ["panda_sim", "ur5e_rtde", "fr3"])
def test_no_number_of_the_state_jumps_at_home(turn: str, profile: str) -> None:
    arm = load_profile(profile)
    state = state_numbers(read_parts(turn), arm)
    home = rotation_from_quat(np.array(home_orientation(arm)))
    random, standing = np.random.default_rng(3), seen(arm)
    told = []
    for _ in range(100):
        noisy = home @ exp3(random.normal(0, NOISE_RAD, 3))
        quat = random.choice([-1.0, 1.0]) * quat_from_rotation(noisy)
        pose = PoseState(np.zeros(3), quat, np.zeros(6))
        told.append(state.encode(replace(standing, pose=pose)))
    assert np.ptp(told, axis=0).max() < 20 * NOISE_RAD


def test_a_checkpoint_s_own_rule_overrides_the_home_orientation() -> None:
    down = seen(PANDA, pose=PoseState(np.zeros(3), np.array([-1.0, 0, 0, 1e-5]), np.zeros(6)))

    def told(text: str) -> list[float]:
        options = {**ARMS["absolute rotvec"], **GRIPPERS["none"], **REST}
        units = read_action_semantics({**options, "rotation_reference": text}).state_units
        return state_numbers(("rotvec",), PANDA, units).encode(down).tolist()

    assert told("home")[0] == pytest.approx(math.pi, abs=1e-3)
    assert told("1,0,0,0")[0] == pytest.approx(math.pi, abs=1e-3)
    assert told("0,0,0,1")[0] == pytest.approx(-math.pi, abs=1e-3)
    assert told("-1,0,0,0")[0] == pytest.approx(-math.pi, abs=1e-3)
    for wrong in ("", "home,1", "1,0,0", "2,0,0,0", "0,0,0,-1"):
        with pytest.raises(SpecError, match="rotation_reference is"):
            told(wrong)


def test_the_home_orientation_is_that_of_the_profile() -> None:
    assert home_reference(PANDA) == pytest.approx(home_orientation(PANDA))
    assert home_reference(PANDA)[0] == pytest.approx(1.0, abs=0.1)


# -- contradictions -------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"joint_scale_rad": "0"}, "joint_scale_rad is 0"),
        ({"joint_scale_rad": "1,0,1,1,1"}, "joint_scale_rad is 0"),
        ({"joint_zero": "1,2"}, "joint_zero has 2 numbers for 5 joints"),
        ({"joint_zero": "x"}, "joint_zero is 'x'"),
        ({"action": "joint_velocity", "joint_zero": "1", "anchor": "goal"}, "a change has no zero"),
    ],
)
def test_units_that_cannot_be_are_named(options: dict[str, str], why: str) -> None:
    told = {**DEGREES, **GRIPPERS["none"], **REST, **options}
    with pytest.raises(SpecError, match=why):
        read_action_semantics(told, joints=SO101.robot.arm_joints)


def test_a_gripper_that_is_told_closed_has_no_range() -> None:
    units = meaning("degrees", "percent").state_units
    with pytest.raises(SpecError, match="gripper_range says other numbers: name gripper_open"):
        state_numbers(read_parts("joint+gripper_closed"), SO101, units)


@pytest.mark.parametrize("arm", ["degrees from another zero", "one unit each"])
def test_joints_of_another_zero_or_direction_are_no_degrees_of_the_profile(arm: str) -> None:
    units = meaning(arm, "percent").state_units
    with pytest.raises(SpecError, match="another zero or direction: name joint"):
        state_numbers(read_parts("joint_deg+gripper_open"), SO101, units)
