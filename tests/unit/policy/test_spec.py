"""The model contract: a spec says all there is to say, and its hash stands for it."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from random_records import model_specs

from vla_zenoh.errors import SpecError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import (
    ROTATION_SIZE,
    ActionSpec,
    CameraSpec,
    ControllerSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
    StatePart,
    check_steps,
)
from vla_zenoh.policy.meaning import GripperScale
from vla_zenoh.policy.observation import STATE_KINDS
from vla_zenoh.policy.spec import FIELD_OF, STREAM_OF

SPEC = ModelSpec(
    name="openvla",
    observation=ObservationSpec(
        cameras=(CameraSpec(camera="front", width=224, height=224, resize="stretch"),),
        state=("pose", "gripper"),
    ),
    action=ActionSpec(horizon=1, dt_s=0.2, gripper="binary"),
)
SPEC_HASH = "7f27aed900060800"
"""Pinned: workers and command nodes of different builds must agree on it."""


# -- hash -------------------------------------------------------------------------------------
def test_the_hash_of_a_known_spec_is_known() -> None:
    assert SPEC.hash == SPEC_HASH


def test_a_copy_with_another_meaning_has_another_hash_also_when_the_first_was_asked_for() -> None:
    before = SPEC.hash
    other = SPEC.model_copy(
        update={"action": SPEC.action.model_copy(update={"gripper_open_is_high": False})}
    )
    assert other.hash != before
    assert other.hash == ModelSpec.from_dict(other.to_dict()).hash


def test_the_hash_is_the_same_in_another_process() -> None:
    code = (
        "import json, sys; from vla_zenoh.policy import ModelSpec;"
        "print(ModelSpec.from_dict(json.loads(sys.argv[1])).hash)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(SPEC.to_dict())],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == SPEC.hash


def meanings(model: BaseModel, place: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """The place of every single value a spec declares."""
    places: list[tuple[str, ...]] = []
    for name in type(model).model_fields:
        value = getattr(model, name)
        inner = isinstance(value, BaseModel)
        places += meanings(value, (*place, name)) if inner else [(*place, name)]
    return places


def replaced(data: dict[str, Any], place: tuple[str, ...], value: Any) -> dict[str, Any]:
    name, *rest = place
    return data | {name: replaced(data[name], tuple(rest), value) if rest else value}


CAMERAS = [{"camera": "front"}, {"camera": "wrist", "width": 64, "height": 64, "resize": "pad"}]
OTHER_VALUES: dict[tuple[str, ...], list[Any]] = {
    ("name",): ["other"],
    ("observation", "cameras"): [[], CAMERAS[:1], CAMERAS, CAMERAS[::-1]],
    ("observation", "depth"): [
        [{"camera": "front"}],
        [{"camera": "front", "unit_m": 0.01}],
        [{"camera": "front", "near_m": 0.1}],
        [{"camera": "front", "far_m": 2.0}],
        [{"camera": "front", "invalid": 65535}],
    ],
    ("observation", "state"): [[], ["joint"], ["gripper", "pose"]],
    ("observation", "prompt"): [False],
    ("observation", "max_skew_s"): [0.05],
    ("observation", "max_age_s"): [0.4],
    ("observation", "history_start"): ["wait"],
    ("every_step",): [True],
    ("action", "horizon"): [2, 50],
    ("action", "dt_s"): [0.1, 0.25],
    ("action", "kind"): ["absolute"],
    ("action", "frame"): ["tcp"],
    ("action", "anchor"): ["measured"],
    ("action", "relative_to"): ["start"],
    ("action", "controller"): [{"kp": 150.0}, {"kp": 80.0}, {"kp": 150.0, "damping_ratio": 0.7}],
    ("action", "rotation"): ["rotvec", "quaternion"],
    ("action", "position_scale_m"): [0.01],
    ("action", "gripper"): ["none", "delta_m", "absolute_m", "open_fraction"],
    ("action", "gripper_open_is_high"): [False],
    ("action", "gripper_threshold"): [0.4],
    ("action", "normalisation"): ["bridge_orig"],
    ("action", "pace"): ["soonest"],
    ("action", "turns"): ["counted"],
    ("action", "parts"): [
        [{"part": part, "action": {"horizon": 1, "dt_s": 0.2}} for part in names]
        for names in (["left"], ["left", "right"], ["right", "left"])
    ],
}


def test_every_declared_value_has_another_one_here() -> None:
    together = {("action", "space"), ("action", "joints")}
    together |= {("observation", "history"), ("observation", "history_spacing_s")}
    assert set(meanings(SPEC)) == {*OTHER_VALUES, *together}


def test_the_length_and_the_spacing_of_a_history_are_meanings_of_their_own() -> None:
    def looking_back(n: int, spacing_s: float) -> ModelSpec:
        seen = SPEC.to_dict()["observation"] | {"history": n, "history_spacing_s": spacing_s}
        return ModelSpec.from_dict(SPEC.to_dict() | {"observation": seen})

    hashes = {SPEC.hash, *(looking_back(*each).hash for each in ((2, 0.1), (3, 0.1), (2, 0.2)))}
    assert len(hashes) == 4


def test_joints_and_their_order_are_meanings_of_their_own() -> None:
    def named(*joints: str) -> ModelSpec:
        return ModelSpec.from_dict(
            replaced(
                replaced(SPEC.to_dict(), ("action", "space"), "joint"), ("action", "joints"), joints
            )
        )

    hashes = {SPEC.hash, named("a", "b").hash, named("b", "a").hash, named("a").hash}
    assert len(hashes) == 4


@pytest.mark.parametrize("place", OTHER_VALUES, ids=".".join)
def test_another_meaning_has_another_hash(place: tuple[str, ...]) -> None:
    others = [ModelSpec.from_dict(replaced(SPEC.to_dict(), place, v)) for v in OTHER_VALUES[place]]
    hashes = {SPEC.hash, *(other.hash for other in others)}
    assert len(hashes) == len(others) + 1


@pytest.mark.parametrize(
    "change",
    [{"camera": "wrist"}, {"width": 256}, {"height": 256}, {"resize": "crop"}, {"colour": "bgr"}],
    ids=str,
)
def test_another_picture_has_another_hash(change: dict[str, Any]) -> None:
    camera = SPEC.to_dict()["observation"]["cameras"][0] | change
    place = ("observation", "cameras")
    assert ModelSpec.from_dict(replaced(SPEC.to_dict(), place, [camera])).hash != SPEC.hash


@settings(max_examples=30)
@given(model_specs, model_specs)
def test_the_hash_differs_exactly_where_specs_differ(one: ModelSpec, other: ModelSpec) -> None:
    assert (one.hash == other.hash) == (one == other)


def test_zero_is_zero_whatever_its_sign() -> None:
    specs = [ActionSpec(horizon=1, dt_s=0.1, gripper_threshold=zero) for zero in (0.0, -0.0)]
    assert len({ModelSpec(name="x", action=spec).hash for spec in specs}) == 1


@settings(max_examples=30)
@given(model_specs)
def test_a_spec_comes_back_from_plain_data(spec: ModelSpec) -> None:
    back = ModelSpec.from_dict(json.loads(json.dumps(spec.to_dict())))
    assert back == spec
    assert back.hash == spec.hash


def test_a_spec_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        SPEC.action.dt_s = 1.0  # pyright: ignore[reportAttributeAccessIssue]


# -- what is refused --------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("name",), "", "name: must not be empty"),
        (("name",), 5, "name: wants text"),
        (("name",), b"x", "name: wants text"),
        (("name",), "\ud800", "name: holds half a character"),
        (("action", "horizon"), 0, "action.horizon: must be at least 1"),
        (("action", "horizon"), True, "action.horizon: wants a whole number"),
        (("action", "horizon"), "8", "action.horizon: wants a whole number"),
        (("action", "horizon"), 8.0, "action.horizon: wants a whole number"),
        (("action", "horizon"), 10**400, "action.horizon: must be at most 1000"),
        (("action", "dt_s"), True, "action.dt_s: wants a number"),
        (("action", "dt_s"), "0.1", "action.dt_s: wants a number"),
        (("action", "dt_s"), float("nan"), "action.dt_s: wants a finite number"),
        (("action", "dt_s"), 0, r"action.dt_s: must be greater than 0"),
        (("action", "rotation"), "rpi", "action.rotation: wants .*; did you mean 'rpy'"),
        (("action", "frame"), None, "action.frame: wants 'base' or 'tcp'"),
        (("action", "dt"), 0.1, "action.dt: is not known here"),
        (("action",), [], "action: wants a map"),
        (("observation", "state"), "pose", "observation.state: wants a list"),
        (
            ("observation", "state"),
            ["pose", "pose"],
            "observation.state: .* given once: pose, pose",
        ),
        (("observation", "state"), ["speed"], "observation.state.0: wants 'joint'"),
        (("observation", "cameras"), [{"camera": "a"}] * 2, "given once: a, a"),
        (("observation", "cameras"), [{"camera": "a", "width": 64}], "both width and height"),
        (("observation", "cameras"), [{"camera": "a", "resize": "pad"}], "'pad' needs width"),
        (("observation", "depth"), [{"camera": "a"}] * 2, "given once: a, a"),
        (
            ("observation", "depth"),
            [{"camera": "a", "near_m": 0.5, "far_m": 0.5}],
            "must be more than near_m",
        ),
        (("observation", "cameras"), [{}], "observation.cameras.0.camera: is missing"),
        (("observation", "cameras"), [{"camera": f"c{n}"} for n in range(17)], "at most 16"),
    ],
)
def test_a_wrong_spec_names_the_field(place: tuple[str, ...], value: Any, said: str) -> None:
    data = replaced(SPEC.to_dict() | {"action": SPEC.to_dict()["action"]}, place, value)
    with pytest.raises(SpecError, match=said):
        ModelSpec.from_dict(data)


@pytest.mark.parametrize("data", [None, 5, [], "spec", {}, {"name": "x"}])
def test_what_is_no_spec_at_all_is_refused(data: Any) -> None:
    with pytest.raises(
        SpecError, match=r"not a valid model spec: (spec: wants a map|.*is missing)"
    ):
        ModelSpec.from_dict(data)


def test_every_wrong_field_is_named_and_a_flood_is_cut() -> None:
    with pytest.raises(SpecError) as caught:
        ModelSpec.from_dict({"name": 1, "action": {"horizon": 0}, "colour": 3})
    assert [part.split(":")[0] for part in str(caught.value).split("spec: ", 1)[1].split("; ")] == [
        "name",
        "action.horizon",
        "action.dt_s",
        "colour",
    ]
    with pytest.raises(SpecError) as caught:
        ModelSpec.from_dict({str(n): "x" * 1000 for n in range(1000)})
    assert len(str(caught.value)) < 8000


def test_an_absolute_pose_is_in_the_base_frame() -> None:
    with pytest.raises(ValidationError, match="set frame: base"):
        ActionSpec(horizon=1, dt_s=0.1, kind="absolute", frame="tcp")


# -- steps ------------------------------------------------------------------------------------
ACTION = ActionSpec(horizon=4, dt_s=0.1)


def test_the_dimension_is_position_rotation_and_gripper() -> None:
    for rotation, size in ROTATION_SIZE.items():
        for gripper in ("none", "binary"):
            spec = ActionSpec(horizon=1, dt_s=0.1, rotation=rotation, gripper=gripper)
            assert spec.dimension == 3 + size + (gripper == "binary")


@pytest.mark.parametrize(
    "steps", [np.zeros((4, 7)), np.zeros((1, 7), np.int8), [[0] * 7], [0.0] * 7]
)
def test_steps_of_the_declared_shape_become_float32(steps: Any) -> None:
    checked = check_steps(ACTION, steps)
    assert checked.dtype == np.float32
    assert checked.shape == (np.size(steps) // 7, 7)


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (np.zeros((4, 6)), r"steps have shape \(4, 6\), the spec says \(H, 7\)"),
        (np.zeros(6), r"steps have shape \(6,\)"),
        (np.zeros((1, 4, 7)), r"steps have shape \(1, 4, 7\)"),
        (np.zeros((5, 7)), "a chunk of 5 steps, the spec says 1 to 4"),
        (np.zeros((0, 7)), "a chunk of 0 steps"),
        (np.full((1, 7), np.nan), "NaN or infinity"),
        (np.full((1, 7), 1e300), "NaN or infinity"),
        (np.ones((1, 7), bool), "not numbers but bool"),
        ([["0"] * 7], "not numbers"),
        ([[0] * 7, [0] * 6], "not numbers"),
        (None, "not numbers but object"),
        ({"steps": 1}, "not numbers but object"),
    ],
)
def test_steps_that_break_the_contract_are_refused(steps: Any, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        check_steps(ACTION, steps)


# -- example ----------------------------------------------------------------------------------
STATE_PARTS: tuple[StatePart, ...] = get_args(StatePart)


@pytest.mark.parametrize("part", STATE_PARTS)
def test_a_part_of_the_state_is_in_an_observation_in_a_record_and_among_what_is_tried(
    part: StatePart,
) -> None:
    field = FIELD_OF.get(part, part)
    assert field in {each.name for each in dataclasses.fields(Observation)}
    record = STATE_KINDS[STREAM_OF.get(part, part)]
    assert part in STATE_KINDS or field in {each.name for each in dataclasses.fields(record)}
    spec = SPEC.model_copy(update={"observation": ObservationSpec(state=(part,))})
    assert getattr(example_observation(spec), field) is not None


def holds(spec: ModelSpec, observation: Observation) -> bool:
    wanted = spec.observation
    return (
        list(observation.images) == [camera.camera for camera in wanted.cameras]
        and all(
            observation.images[c.camera].shape == (c.height or 480, c.width or 640, 3)
            and observation.images[c.camera].dtype == np.uint8
            for c in wanted.cameras
        )
        and {p for p in STATE_PARTS if getattr(observation, FIELD_OF.get(p, p)) is not None}
        == set(wanted.state)
    )


@settings(max_examples=30)
@given(model_specs)
def test_an_example_is_what_the_spec_asks_for(spec: ModelSpec) -> None:
    assume(len(spec.name) <= 128)
    observation = example_observation(spec)
    assert holds(spec, observation)
    assert observation.prompt
    assert observation.rate_hz > 0


@given(st.text(st.characters(exclude_categories=("Cs",)), max_size=50))
def test_an_example_has_the_prompt_it_was_given(prompt: str) -> None:
    assert example_observation(SPEC, prompt=prompt).prompt == prompt


def test_joints_have_no_scale_of_positions() -> None:
    with pytest.raises(ValueError, match="give joints in rad"):
        ActionSpec(horizon=1, dt_s=0.1, space="joint", joints=("a",), position_scale_m=0.01745)


@pytest.mark.parametrize("threshold", [0.0, -0.0])
def test_zero_and_minus_zero_are_the_same_threshold_on_the_wire(threshold: float) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, gripper="binary", gripper_threshold=threshold)
    assert '"gripper_threshold": 0.0' in json.dumps(ModelSpec(name="m", action=action).to_dict())


@pytest.mark.parametrize(("threshold", "ends"), [(0.0, (-1.0, 1.0)), (0.5, (0.0, 1.0))])
def test_a_binary_gripper_is_told_as_the_two_numbers_that_its_threshold_lies_between(
    threshold: float, ends: tuple[float, float]
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, gripper="binary", gripper_threshold=threshold)
    for is_high, (shut, opened) in ((True, ends), (False, ends[::-1])):
        told = action.model_copy(update={"gripper_open_is_high": is_high}).gripper_scale(0.08)
        assert told == GripperScale(shut, opened)


@pytest.mark.parametrize(
    "other", [{"kind": "absolute"}, {"frame": "tcp"}, {"relative_to": "start"}]
)
def test_a_controller_covers_nothing_but_deltas_in_the_base_frame_one_after_the_other(
    other: dict[str, Any],
) -> None:
    with pytest.raises(ValidationError, match="a controller covers deltas"):
        ActionSpec(horizon=1, dt_s=0.1, controller=ControllerSpec(kp=150.0), **other)
