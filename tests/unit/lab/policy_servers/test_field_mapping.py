"""What a server is sent and what its answer means, for known robots and by options."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from model_wires import groot, openpi, openvla_rest, origami
from vla_zenoh_policy_servers import action_semantics as meaning
from vla_zenoh_policy_servers import field_mapping
from vla_zenoh_policy_servers.adapter import FIRST_S, LONGEST_S, Backoff
from vla_zenoh_policy_servers.field_mapping import (
    DEFAULTS,
    FieldMapping,
    read_columns,
    read_field_mapping,
)
from vla_zenoh_policy_servers.presets import Presets
from vla_zenoh_serve import openpi_server

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, JointState, PoseState

WIDTH_M = 0.08
ABSOLUTE = {"action": "absolute", "gripper": "binary", "gripper_open": "high", "dt_s": "0.1"}
ATOL, ATOL_F32 = 1e-9, 1e-6
ALL: dict[str, tuple[Presets, str]] = {
    f"{model}/{preset}": (presets, preset)
    for model, presets in {
        "openpi": openpi.PRESETS,
        "groot": groot.PRESETS,
        "openvla_rest": openvla_rest.PRESETS,
        "origami": origami.PRESETS,
    }.items()
    for preset in presets
}


def layout(
    presets: Presets = openpi.PRESETS, /, preset: str = "libero", **options: str
) -> FieldMapping:
    profile = load_profile("panda_sim")
    return read_field_mapping("x", presets, preset, options, profile=profile)


def steps_of(of: FieldMapping, answer: Any) -> np.ndarray[Any, Any]:
    return np.asarray(of.read(answer).steps)


def seen(of: FieldMapping, rotvec: Any = (0.1, -0.2, 0.3), width_m: float = 0.06) -> Observation:
    """An observation with a pose that tells its parts apart."""
    found = example_observation(of.spec, prompt="put it there")
    quat = quat_from_rotation(exp3(np.array(rotvec, float)))
    home_rad = np.array(load_profile("panda_sim").robot.home_rad)
    names, none = load_profile("panda_sim").robot.arm_joints, np.zeros(7)
    return replace(
        found,
        pose=PoseState(np.array([0.4, -0.1, 0.3]), quat, np.zeros(6)) if found.pose else None,
        joint=JointState(names, home_rad, none, none) if found.joint else None,
        gripper=GripperState(width_m, False, False) if found.gripper else None,
    )


# -- what is sent ---------------------------------------------------------------------------------
def test_liberos_state_is_position_axis_angle_and_both_fingers() -> None:
    of = layout()
    state = of.request(seen(of))["observation/state"]
    assert state.dtype == np.float32
    np.testing.assert_allclose(state, [0.4, -0.1, 0.3, 0.1, -0.2, 0.3, 0.03, -0.03], atol=ATOL_F32)


def test_droids_gripper_is_0_when_open() -> None:
    of = layout(preset="droid")
    sent = of.request(seen(of, width_m=WIDTH_M))
    assert sent["observation/gripper_position"].tolist() == [0.0]
    assert sent["observation/joint_position"].shape == (7,)
    assert set(sent) == {
        "observation/exterior_image_1_left",
        "observation/wrist_image_left",
        "observation/joint_position",
        "observation/gripper_position",
        "prompt",
    }


@pytest.mark.parametrize("name", ALL)
def test_every_preset_makes_a_spec_and_a_question(name: str) -> None:
    of = layout(*ALL[name])
    sent = of.request(seen(of))
    assert [value for value in sent.values() if isinstance(value, str)] == ["put it there"]
    for value in sent.values():
        assert isinstance(value, str) or value.dtype in (np.uint8, np.float32)


# -- what an answer means -------------------------------------------------------------------------
def test_one_unit_of_libero_is_5_cm_and_half_a_radian_and_more_is_clipped() -> None:
    of = layout()
    answer = {"actions": np.array([[1, -0.5, 0, 0, 0.5, 0, -1], [9, 0, 0, 0, 0, -9, 1]])}
    steps = steps_of(of, answer)
    expected = [[1, -0.5, 0, 0, 0.25, 0, -1], [1, 0, 0, 0, 0, -0.5, 1]]
    np.testing.assert_allclose(steps, expected, atol=ATOL)
    action = of.spec.action
    assert action.position_scale_m == pytest.approx(0.05)
    assert (action.kind, action.rotation) == ("delta", "rotvec")
    assert (action.gripper, action.gripper_open_is_high, action.gripper_threshold) == (
        "binary",
        False,
        0.0,
    )


def test_what_the_server_said_is_kept_for_people() -> None:
    of = layout()
    answer = np.array([[1.0, 0, 0, 0, 0, 0, -1]])
    result = of.read(answer)
    assert result.raw == {"first_step": answer[0].tolist()}
    np.testing.assert_array_equal(result.steps, steps_of(of, answer))


def test_joint_deltas_stay_joint_deltas_in_the_units_of_the_arm() -> None:
    of = layout(preset="droid")
    answer = np.zeros((3, 8))
    answer[:, 1], answer[:, 7] = 0.5, 1.0
    np.testing.assert_allclose(steps_of(of, {"actions": answer}), [[0, 0.1, 0, 0, 0, 0, 0, 1]] * 3)
    action = of.spec.action
    assert (action.space, action.kind, action.anchor) == ("joint", "delta", "goal")
    assert action.joints == load_profile("panda_sim").robot.arm_joints
    assert not action.gripper_open_is_high


def test_joint_velocities_are_asked_for_their_start_only() -> None:
    told = {"action": "joint_velocity", "gripper": "none", "dt_s": "0.1", "horizon": "8"}
    told |= {"joint_scale_rad": "1"}
    with pytest.raises(SpecError, match=r"is missing: --set anchor=\("):
        layout(preset="none", map=MINE["map"], **told)
    of = layout(preset="none", map=MINE["map"], anchor="goal", **told)
    assert (of.spec.action.space, of.spec.action.kind) == ("joint", "velocity")


@pytest.mark.parametrize(
    ("ends", "number", "fraction"),
    [("0:100", 25.0, 0.25), ("0:1.7", 1.7, 1.0), ("1.0:-0.5", 1.0, 0.0), ("1.0:-0.5", -0.5, 1.0)],
)
def test_a_gripper_among_the_joints_of_an_action_is_a_fraction_of_its_range(
    ends: str, number: float, fraction: float
) -> None:
    """LeRobot's SO-101: joints in degrees, and the gripper in percent, or in rad."""
    told = {**MINE, "joint_scale_rad": "0.0174533", "gripper_range": ends, "gripper_open": ""}
    of = layout(preset="none", **told)
    (step,) = steps_of(of, {"actions": np.array([[90.0, *[0.0] * 6, number]])})
    np.testing.assert_allclose(step, [np.pi / 2, *[0.0] * 6, fraction], atol=1e-5)
    assert of.spec.action.gripper_open_is_high


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ({"gripper_range": "0:100"}, "in place of gripper_open"),
        ({"gripper_range": "5", "gripper_open": ""}, "wanted SHUT:OPEN"),
        ({"gripper_range": "5:5", "gripper_open": ""}, "wanted SHUT:OPEN"),
        ({"joint_scale_rad": "1,0.001"}, "2 numbers for 7 joints"),
    ],
)
def test_a_range_or_scale_that_cannot_be_is_rejected(told: dict[str, str], why: str) -> None:
    with pytest.raises(SpecError, match=why):
        layout(preset="none", **{**MINE, **told})


def test_each_joint_may_have_a_unit_of_its_own() -> None:
    scales = ",".join(["0.001", *["1"] * 6])
    of = layout(preset="none", **{**MINE, "joint_scale_rad": scales})
    (step,) = steps_of(of, {"actions": np.array([[250.0, *[0.5] * 6, 0.0]])})
    np.testing.assert_allclose(step, [0.25, *[0.5] * 6, 0.0], atol=1e-6)


def test_what_a_joint_delta_is_added_to_is_not_guessed() -> None:
    told = {"action": "joint_delta", "gripper": "none", "dt_s": "0.1", "horizon": "8"}
    with pytest.raises(SpecError, match=r"--set relative_to=\(.*--set anchor=\("):
        layout(preset="none", map=MINE["map"], **told)


def test_origami_takes_the_columns_of_one_arm() -> None:
    of = layout(origami.PRESETS, "north_right")
    observation = seen(of)
    state = of.request(observation)["observation/state"]
    assert observation.joint is not None
    assert state.shape == (65,)
    np.testing.assert_allclose(state[29:36], observation.joint.position_rad, atol=ATOL_F32)
    joints_rad = steps_of(of, state[None].astype(float))
    np.testing.assert_allclose(joints_rad, [observation.joint.position_rad], atol=1e-5)


def test_a_quaternion_may_begin_with_w() -> None:
    of = layout(**ABSOLUTE, rotation="quat_wxyz")
    answer = np.array([[0.4, 0, 0.3, 2**-0.5, 2**-0.5, 0, 0, 1]])
    steps = steps_of(of, answer)
    np.testing.assert_allclose(steps, [[0.4, 0, 0.3, 2**-0.5, 0, 0, 2**-0.5, 1]], atol=ATOL)
    with pytest.raises(PeerError, match="quaternion of norm"):
        steps_of(of, np.array([[0.4, 0, 0.3, 0.1, 0, 0, 0, 1]]))


def test_named_parts_stand_side_by_side_whatever_their_shape() -> None:
    of = layout(groot.PRESETS, "bridge", keys="move,gripper", horizon="3")
    move = np.arange(24.0).reshape(1, 4, 6) / 100
    for grip in (np.ones((1, 4, 1)), np.ones((4, 1)), np.ones(4)):
        steps = steps_of(of, {"move": move, "gripper": grip, "more": "x"})
        assert steps.shape == (3, 7)
        np.testing.assert_allclose(steps[:, :6], move[0, :3], atol=ATOL)


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({"other": np.zeros((2, 7))}, "has no 'actions'; it has: other"),
        ({"actions": np.zeros((2, 6))}, "6 columns, wanted 7: position 3"),
        ({"actions": np.zeros((0, 7))}, "has no steps"),
        ({"actions": np.zeros((2, 2, 7))}, r"shape \(2, 2, 7\)"),
        ({"actions": np.full((2, 7), np.nan)}, "NaN or infinity"),
        ({"actions": np.full((2, 7), np.inf)}, "NaN or infinity"),
        ({"actions": "up"}, "is not numbers"),
        ({"actions": [[1, 2], [3]]}, "is not a table of numbers"),
        ({"actions": None}, "is not numbers"),
    ],
)
def test_an_answer_of_another_form_is_refused_by_name(answer: Any, why: str) -> None:
    of = layout()
    with pytest.raises(PeerError, match=why) as raised:
        steps_of(of, answer)
    assert raised.value.reason == "peer_reply"


# -- options --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"sice": "1x1"}, "no option 'sice'; known: map, size"),
        ({"size": "big"}, "wanted WIDTHxHEIGHT"),
        ({"resize": "squeeze"}, "resize"),
        ({"map": "a"}, "NAME=SOURCE"),
        ({"map": "a=posture"}, "no part of the state is called 'posture'; there are: joint"),
        ({"map": "a=kamera:front"}, "a source is camera:NAME"),
        ({"map": "a=x,a=y"}, "twice"),
        ({"action": "twist"}, "allowed: delta, absolute, velocity, joint_delta, joint_position"),
        ({"rotation": "euler"}, "allowed: rpy, rotvec"),
        ({"gripper": "maybe"}, "gripper"),
        ({"gripper_open": "left"}, "allowed: high, low"),
        ({"dt_s": "0"}, "dt_s"),
        ({"dt_s": "soon"}, "wanted a number"),
        ({"horizon": "1.5"}, "whole number"),
        ({"position_scale_m": "-1"}, "from 0 up"),
        ({"frame": "camera"}, "frame"),
        ({**ABSOLUTE, "rotation": "rpy", "frame": "tcp"}, "base frame"),
        ({"columns": "7:0"}, "wanted 0:7"),
        ({"keys": "x,,y"}, "keys"),
    ],
)
def test_an_option_that_cannot_be_is_refused_and_says_what_can(
    options: dict[str, str], why: str
) -> None:
    with pytest.raises(SpecError, match=why):
        layout(**options)


MINE = {
    "map": "image=camera:front, state=joint+gripper_open, prompt=prompt",
    "action": "joint_position",
    "joint_scale_rad": "1",
    "gripper": "open_fraction",
    "gripper_open": "high",
    "dt_s": "0.05",
    "horizon": "10",
}
"""A server of one's own: absolute joints, and a gripper from 0 to 1."""


def test_a_server_of_ones_own_is_told_with_every_option_and_no_name_of_a_preset() -> None:
    of = layout(preset="none", **MINE)
    assert set(of.fields) == {"image", "state", "prompt"}
    home_rad = load_profile("panda_sim").robot.home_rad
    steps = steps_of(of, {"actions": np.array([[*home_rad, 0.25]])})
    np.testing.assert_allclose(steps, [[*home_rad, 0.25]], atol=ATOL)
    assert (of.spec.action.space, of.spec.action.kind) == ("joint", "absolute")


@pytest.mark.parametrize(
    "name", ["action", "joint_scale_rad", "gripper", "gripper_open", "dt_s", "horizon"]
)
def test_of_a_server_of_ones_own_no_meaning_is_guessed(name: str) -> None:
    with pytest.raises(SpecError, match=rf"the meaning of the numbers is missing: --set {name}=\("):
        layout(preset="none", **{k: v for k, v in MINE.items() if k != name})
    with pytest.raises(SpecError, match=r"--set rotation=\(rpy or rotvec"):
        layout(preset="none", **{**MINE, "action": "delta"})


def test_another_action_than_the_presets_keeps_nothing_of_what_it_says_of_numbers() -> None:
    told = {"joint_scale_rad": "1", "gripper": "none", "dt_s": "0.1"}
    home_rad = np.array(load_profile("panda_sim").robot.home_rad)
    for preset in ("libero", "droid"):  # LIBERO's clip, DROID's 0.2 rad to the unit
        of = layout(preset=preset, action="joint_position", **told)
        np.testing.assert_allclose(steps_of(of, home_rad[None]), home_rad[None], atol=ATOL)
    of = layout(action="absolute", rotation="rpy", **told)
    steps = steps_of(of, np.array([[0.5, 0, 0.3, 0, 0, 2.0]]))
    np.testing.assert_allclose(steps, [[0.5, 0, 0.3, 0, 0, 2.0]], atol=ATOL)
    with pytest.raises(
        SpecError, match="joint_position is not that of preset droid, so the meaning"
    ):
        layout(preset="droid", action="joint_position")


def test_the_action_that_the_preset_has_anyway_changes_nothing() -> None:
    assert layout(action="delta") == layout()


def test_an_unknown_preset_is_refused_with_those_there_are() -> None:
    with pytest.raises(SpecError, match="preset is 'bridge', allowed: libero, droid, own, none"):
        layout(preset="bridge")


def test_a_map_changes_single_names_of_a_preset() -> None:
    of = layout(map="observation/wrist_image=, observation/image=camera:top")
    assert [camera.camera for camera in of.spec.observation.cameras] == ["top"]
    assert set(of.fields) == {"observation/image", "observation/state", "prompt"}


def test_columns() -> None:
    assert read_columns("") is None
    assert read_columns("2:5") == (2, 3, 4)
    assert read_columns("0,1,6") == (0, 1, 6)


def test_the_spec_of_every_option_has_its_default_documented() -> None:
    told = f"{field_mapping.__doc__}{meaning.__doc__}"
    assert all(name in told for name in DEFAULTS)


# -- what servers say of themselves ---------------------------------------------------------------
def test_a_server_that_says_what_is_set_fits() -> None:
    of = layout(preset="own")
    said = openpi.read_metadata(openpi_server.metadata(of.spec.action, {}))
    assert openpi.mismatches(said, of) == []
    assert openpi.mismatches({}, of) == []


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ({"action_dim": 8}, "8 columns, 7 are wanted"),
        ({"action_space": "joint_position"}, "action=delta is set"),
        ({"image_resolution": [180, 320]}, "images of 320x180, size=224x224"),
        ({"vla_zenoh_action": {"gripper_open_is_high": True}}, "gripper_open_is_high"),
        ({"vla_zenoh_action": {"dt_s": 0.1}}, "dt_s is 0.1, 0.05 is set"),
    ],
)
def test_what_openpis_server_says_otherwise_is_named(said: dict[str, Any], named: str) -> None:
    (wrong,) = openpi.mismatches(said, layout())
    assert named in wrong


def test_what_groots_server_says_otherwise_is_named() -> None:
    of = layout(groot.PRESETS, "bridge")
    said = {
        "video": {"modality_keys": ["image_0", "wrist"], "delta_indices": [-1, 0]},
        "state": {"modality_keys": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]},
        "action": {"modality_keys": ["eef"]},
        "language": {"modality_keys": ["task"]},
    }
    told = "; ".join(groot.mismatches(said, of))
    for part in (
        "it wants video wrist",
        "2 video entries in time",
        "does not know state pad",
        "it gives no action",
        "its prompt is called task",
    ):
        assert part in told


def test_what_origamis_policy_says_otherwise_is_named() -> None:
    of = layout(origami.PRESETS, "north_right")
    fits = {"action_dim": 65, "action_type": "absolute_joint_position", "action_units": "radians"}
    assert origami.mismatches(fits, of) == []
    assert "column 35" in origami.mismatches({**fits, "action_dim": 14}, of)[0]
    assert "'degrees'" in origami.mismatches({**fits, "action_units": "degrees"}, of)[0]
    assert "delta_pose" in origami.mismatches({"action_type": "delta_pose"}, of)[0]
    assert origami.mismatches(None, of)


# -- trying again ---------------------------------------------------------------------------------
def test_a_lost_server_is_tried_again_soon_then_less_often_and_after_success_at_once() -> None:
    backoff, now_s, waits = Backoff(), 100.0, []
    for _ in range(6):
        assert backoff.wait_s(now_s) == 0
        backoff.failed(now_s)
        waits.append(backoff.wait_s(now_s))
        now_s += waits[-1]
    assert waits[0] == pytest.approx(FIRST_S)
    assert waits == sorted(waits)
    assert waits[-1] == pytest.approx(LONGEST_S)
    backoff.failed(now_s)
    backoff.succeeded()
    assert backoff.wait_s(now_s) == 0
