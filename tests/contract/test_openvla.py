"""What the OpenVLA worker makes of pictures, prompts, tokens and statistics; no weights needed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.policy import Policy
from vla_zenoh.policy.loader import find_model, import_model, make_policy

MODEL = import_model(find_model("openvla"))
from vla_zenoh_model_openvla import picture, tokens  # noqa: E402
from vla_zenoh_model_openvla.statistics import Range, read_range  # noqa: E402

BINS = tokens.ActionBins(vocabulary=32000)
BIN = 2 / 255
"""Width of a bin in [-1, 1]."""
ATOL = 1e-12
GREY_LEVELS = 1
"""Rounding of a picture's resizing."""
BRIDGE: dict[str, list[Any]] = {
    "mask": [True] * 6 + [False],
    "q01": [-0.02873, -0.04170, -0.02609, -0.08092, -0.09289, -0.20718, 0.0],
    "q99": [0.02831, 0.04086, 0.04016, 0.08192, 0.07793, 0.20383, 1.0],
}
BOTH: dict[str, Any] = {"bridge_orig": {"action": BRIDGE}, "other": {"action": BRIDGE}}
CONFIG: dict[str, Any] = {
    "model_type": "openvla",
    "vision_backbone_id": "dinosiglip-vit-so-224px",
    "llm_backbone_id": "llama2-7b-pure",
    "n_action_bins": 256,
    "pad_to_multiple_of": 64,
    "norm_stats": BOTH,
    "text_config": {"model_type": "llama", "vocab_size": 32064, "pad_token_id": 32000},
}


def write(
    folder: Path, config: Mapping[str, Any] = CONFIG, statistics: Mapping[str, Any] | None = None
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config))
    if statistics is not None:
        (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    return folder


def make(folder: Path, **options: str) -> Policy:
    return make_policy(find_model("openvla"), {"checkpoint": str(folder), **options})


# -- tokens ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "token"), [(-1.0, 31999), (0.0, 31872), (1.0, 31744)])
def test_the_known_tokens_stand_for_the_ends_and_the_middle(number: float, token: int) -> None:
    assert BINS.encode([number]) == [token]


def test_a_token_decodes_to_the_middle_of_its_bin() -> None:
    assert BINS.decode([31872]) == pytest.approx([0.0], abs=ATOL)
    assert BINS.decode([31999]) == pytest.approx([-1 + BIN / 2], abs=ATOL)
    assert BINS.decode([31745]) == pytest.approx([1 - BIN / 2], abs=ATOL)
    assert BINS.decode([31744]) == BINS.decode([31745])


@given(st.floats(-1.0, 1.0))
def test_what_is_encoded_decodes_to_within_half_a_bin(number: float) -> None:
    back = BINS.decode(list(BINS.encode([number])))
    assert abs(back[0] - number) <= BIN / 2 + ATOL


@pytest.mark.parametrize("token", [0, 2, 29871, 31743, 32000, 32063])
def test_a_token_that_is_no_action_is_refused_by_its_place(token: int) -> None:
    with pytest.raises(SpecError, match=rf"token {token} as number 3 .* 31744 to 31999"):
        BINS.decode([31872, 31872, 31872, token, 31872, 31872, 31872])


def test_the_blank_token_follows_the_prompt_once() -> None:
    assert tokens.prompt_tokens([1, 512, 29901]) == [1, 512, 29901, 29871]
    assert tokens.prompt_tokens([1, 512, 29871]) == [1, 512, 29871]


def test_prompts_are_those_of_the_training() -> None:
    assert tokens.prompt_text("7b", " Put the RED brick in the box") == (
        "In: What action should the robot take to put the red brick in the box?\nOut:"
    )
    assert tokens.prompt_text("v01", "wave").endswith(
        "USER: What action should the robot take to wave? ASSISTANT:"
    )


# -- statistics -----------------------------------------------------------------------------------


def test_only_what_the_mask_names_is_scaled() -> None:
    scale = read_range(BOTH, "bridge_orig")
    np.testing.assert_allclose(scale.expand([-1] * 7), [*BRIDGE["q01"][:6], -1], atol=ATOL)
    np.testing.assert_allclose(scale.expand([1] * 7), [*BRIDGE["q99"][:6], 1], atol=ATOL)


def test_without_a_mask_everything_is_scaled() -> None:
    bare = {"d": {"action": {key: BRIDGE[key] for key in ("q01", "q99")}}}
    np.testing.assert_allclose(read_range(bare, "d").expand([-1] * 7), BRIDGE["q01"], atol=ATOL)


def test_the_middle_of_the_range_is_not_standing_still() -> None:
    middle = read_range(BOTH, "bridge_orig").expand([0] * 7)
    assert middle[2] == pytest.approx(7.0e-3, abs=0.1e-3)
    assert middle[4] == pytest.approx(-7.5e-3, abs=0.1e-3)


@given(st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7))
def test_shrinking_undoes_expanding(numbers: list[float]) -> None:
    scale = read_range(BOTH, "bridge_orig")
    np.testing.assert_allclose(scale.shrink(scale.expand(numbers)), numbers, atol=1e-9)


def test_shrinking_stays_in_the_range_and_leaves_what_is_not_scaled() -> None:
    scale = Range(np.array([0.0, 2.0]), np.array([1.0, 2.0]), np.array([True, False]))
    assert scale.shrink([5.0, 0.5]).tolist() == [1.0, 0.5]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"q99": [0.1] * 6}, "7 numbers in q01, 6 in q99"),
        ({"q01": [float("nan")] * 7}, "not finite"),
        ({"q01": ["0"] * 7}, "list of numbers"),
        ({"q01": None}, "list of numbers"),
        ({"mask": [1] * 7}, "true and false"),
        ({"q01": [2.0] * 7}, "q99 is below q01"),
        ({"q01": BRIDGE["q99"]}, "of number 0 are both 0.02831: it never changed in the data"),
        ({"q01": [0.0] * 14, "q99": [1.0] * 14, "mask": [True] * 14}, "moves one arm with 7"),
    ],
)
def test_statistics_that_cannot_be_are_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(WorkerError, match=match):
        read_range({"d": {"action": {**BRIDGE, **change}}}, "d")


# -- picture --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(480, 640), (224, 224), (120, 160), (1080, 1920)])
@pytest.mark.parametrize("crop", [False, True])
def test_a_plain_picture_stays_plain(size: tuple[int, int], crop: bool) -> None:
    seen = picture.trained_form(np.full((*size, 3), (10, 128, 250), np.uint8), crop=crop)
    assert seen.shape == (224, 224, 3)
    assert np.abs(seen.astype(int) - (10, 128, 250)).max() <= 2 * GREY_LEVELS


def test_the_whole_picture_is_seen_whatever_its_shape() -> None:
    """Stretched, neither cut nor padded, as the training data were."""
    wide = np.zeros((480, 640, 3), np.uint8)
    wide[:, :320] = 255
    seen = picture.lanczos(wide, 224)[..., 0]
    assert (seen[:, :110] > 200).all()
    assert (seen[:, 114:] < 55).all()


def test_a_picture_of_the_right_size_is_not_resized() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    np.testing.assert_array_equal(picture.lanczos(noise, 224), noise)


def test_fine_stripes_become_grey_instead_of_coarse_stripes() -> None:
    """Anti-aliasing: the kernel widens with the picture."""
    stripes = np.zeros((896, 896, 3), np.uint8)
    stripes[:, ::2] = 255
    seen = picture.lanczos(stripes, 224)[:, 4:-4].astype(int)
    assert np.abs(seen - 127.5).max() <= 2


def test_the_crop_is_the_middle_nine_tenths_of_the_area() -> None:
    across = np.linspace(0, 255, 224)
    ramp = np.repeat(np.broadcast_to(across, (224, 224))[..., None], 3, axis=2)
    seen = picture.centre_crop(np.rint(ramp).astype(np.uint8))[112, :, 0].astype(float)
    cut = (1 - np.sqrt(0.9)) / 2
    assert seen[0] == pytest.approx(255 * cut, abs=1.5)
    assert seen[-1] == pytest.approx(255 * (1 - cut), abs=1.5)


# -- the directory --------------------------------------------------------------------------------


def test_the_spec_says_what_the_numbers_mean(tmp_path: Path) -> None:
    action = make(write(tmp_path / "a"), unnorm_key="bridge_orig").spec.action
    assert (action.kind, action.frame, action.rotation) == ("delta", "base", "rpy")
    assert (action.gripper, action.gripper_open_is_high) == ("open_fraction", True)
    assert action.normalisation == "bridge_orig"
    assert action.dt_s == pytest.approx(0.2)
    np.testing.assert_array_equal(
        steps_of(make(tmp_path / "a", unnorm_key="bridge_orig"), [[0.01] * 7]), [[0.01] * 7]
    )


LIBERO: dict[str, list[Any]] = {
    "mask": [True] * 6 + [False],
    "q01": [-0.9375] * 3 + [-0.2] * 3 + [0.0],
    "q99": [0.9375] * 3 + [0.3] * 3 + [1.0],
}
"""In the units of its controller, of which one is 5 cm or half a radian."""


def steps_of(policy: Policy, rows: Any) -> Any:
    """Steps with positions in metres: on the wire they are in the unit that the spec says."""
    steps = vars(policy)["_meaning"].steps(np.array(rows))
    steps[:, :3] *= policy.spec.action.position_scale_m
    return steps


@pytest.mark.parametrize("key", ["libero_spatial_no_noops", "libero_90"])
def test_liberos_numbers_are_those_of_its_controller(tmp_path: Path, key: str) -> None:
    policy = make(write(tmp_path / "a", statistics={key: {"action": LIBERO}}))
    action = policy.spec.action
    assert (action.kind, action.frame, action.rotation) == ("delta", "base", "rotvec")
    assert (action.gripper, action.gripper_open_is_high, action.dt_s) == (
        "open_fraction",
        True,
        0.05,
    )
    assert action.controller is not None
    assert (action.controller.kp, action.controller.damping_ratio) == (150.0, 1.0)
    rows = vars(policy)["_range"].expand([[1.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.7]])
    wanted = [[0.05 * 0.9375, -0.05 * 0.9375, 0, 0.15, -0.1, 0.025, 0.7]]
    np.testing.assert_allclose(steps_of(policy, rows), wanted, atol=ATOL)
    np.testing.assert_allclose(steps_of(policy, [[9.0] * 6 + [1]])[0], [0.05] * 3 + [0.5] * 3 + [1])


def test_the_native_worker_and_the_server_of_the_same_weights_ask_for_the_same(
    tmp_path: Path,
) -> None:
    native = make(write(tmp_path / "a", statistics={"libero_goal_no_noops": {"action": LIBERO}}))
    served: Any = make_policy(find_model("openvla_rest"), {"preset": "libero"})
    rows = np.array([[0.5, -0.25, 0.125, 0.1, -0.2, 0.3, 1.0]])
    theirs = served.mapping.read(rows).steps
    theirs[:, :3] *= served.spec.action.position_scale_m
    np.testing.assert_allclose(steps_of(native, rows), theirs, atol=ATOL)
    assert native.spec.action.controller == served.spec.action.controller
    assert native.spec.action.rotation == served.spec.action.rotation
    assert native.spec.action.dt_s == served.spec.action.dt_s


ADDED = {"anchor": "goal", "relative_to": "previous", "controller": "none"}


def test_data_of_ones_own_may_mean_something_else(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", statistics={"mine": {"action": BRIDGE}})
    told = {"position_scale_m": "0.001", "frame": "tcp", "rotation": "rotvec", "dt_s": "0.1"}
    policy = make(folder, **told, **ADDED, gripper_open="low")
    action = policy.spec.action
    assert (action.frame, action.rotation) == ("tcp", "rotvec")
    assert not action.gripper_open_is_high
    np.testing.assert_allclose(
        steps_of(policy, [[2.0, 0, 0, 0, 0, 0.1, 1]]), [[0.002, 0, 0, 0, 0, 0.1, 1]], atol=ATOL
    )
    absolute = {"action": "absolute", "rotation": "rpy", "gripper": "absolute_m", "dt_s": "0.1"}
    assert make(folder, **absolute).spec.action.gripper == "absolute_m"


def test_statistics_that_are_no_metres_are_refused_until_somebody_says_what_they_are(
    tmp_path: Path,
) -> None:
    folder = write(tmp_path / "a", statistics={"my_kitchen": {"action": LIBERO}})
    with pytest.raises(
        WorkerError, match=r"steps of 0\.938, which are no metres.*position_scale_m"
    ):
        make(folder, **ADDED, dt_s="0.05")
    units = {"position_scale_m": "0.05", "rotation_scale_rad": "0.5", "rotation": "rotvec"}
    policy = make(folder, **units, **ADDED, dt_s="0.05")
    np.testing.assert_allclose(steps_of(policy, [[1.0] * 7]), [[0.05] * 3 + [0.5] * 3 + [1]])


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"action": "joint_position", "gripper": "none"}, "joints are not read by this worker"),
        ({"rotation": "quat_xyzw"}, r"7 numbers, position 3 \+ quat_xyzw 4 \+ gripper 1 are 8"),
        ({"gripper": "none"}, r"7 numbers, position 3 \+ rpy 3 are 6"),
        ({"horizon": "2"}, "horizon is 2; the model's chunks have 1"),
        ({"action": "absolute"}, r"not that of data set 'mine', so the meaning .*--set rotation="),
        ({"controller": ""}, r"--set controller=\(none, or KP:DAMPING_RATIO"),
        ({"controller": "150"}, "wanted none, or KP:DAMPING_RATIO as 150:1"),
        ({"controller": "150:1", "frame": "tcp"}, "deltas in the base frame"),
        ({"anchor": ""}, r"--set anchor=\(goal or measured"),
        ({"scale_m": "1"}, r"no option 'scale_m'; known: action, frame"),
    ],
)
def test_a_meaning_that_cannot_be_is_named(
    tmp_path: Path, told: dict[str, str], match: str
) -> None:
    folder = write(tmp_path / "a", statistics={"mine": {"action": BRIDGE}})
    with pytest.raises(WorkerError, match=match):
        make(folder, **{"dt_s": "0.1", **ADDED, **told})


@pytest.mark.parametrize("key", ["", "brigde_orig"])
def test_a_missing_or_wrong_unnorm_key_lists_those_there_are(tmp_path: Path, key: str) -> None:
    with pytest.raises(WorkerError, match=r"unnorm_key= one of: bridge_orig, other"):
        make(write(tmp_path / "a"), unnorm_key=key)


def test_statistics_beside_the_weights_replace_those_of_the_base_model(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", statistics={"mine": {"action": BRIDGE}})
    assert make(folder, **ADDED, dt_s="0.1").spec.action.normalisation == "mine"
    with pytest.raises(WorkerError, match=r"'bridge_orig' is not in .*dataset_statistics.json"):
        make(folder, unnorm_key="bridge_orig", dt_s="0.1")


def test_the_duration_of_a_step_is_asked_for_where_it_is_not_known(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r"--set dt_s=\(seconds of a step"):
        make(write(tmp_path / "a"), unnorm_key="other")


def test_the_crop_is_on_where_the_name_of_the_run_says_so(tmp_path: Path) -> None:
    plain = make(write(tmp_path / "run"), unnorm_key="bridge_orig")
    trained = make(write(tmp_path / "run+b16--image_aug"), unnorm_key="bridge_orig")
    told = make(tmp_path / "run", unnorm_key="bridge_orig", center_crop="yes")
    assert [vars(p)["_crop"] for p in (plain, trained, told)] == [False, True, True]


def test_a_vicuna_gets_the_prompt_of_the_first_version(tmp_path: Path) -> None:
    old = {**CONFIG, "llm_backbone_id": "vicuna-v15-7b", "vision_backbone_id": "siglip-vit-so400m"}
    policy = make(write(tmp_path / "a", old), unnorm_key="bridge_orig")
    assert vars(policy)["checkpoint"].template == "v01"
    assert len(vars(policy)["checkpoint"].backbones) == 1


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({**CONFIG, "model_type": "llama"}, "model_type is 'llama'"),
        ({**CONFIG, "text_config": {"model_type": "phi"}}, "text_config of a Llama"),
        ({**CONFIG, "vision_backbone_id": "eye"}, "vision_backbone_id 'eye' is not known"),
        ({**CONFIG, "image_sizes": [224]}, "not of one length"),
        ({**CONFIG, "n_action_bins": "256"}, "positive whole numbers"),
        ({**CONFIG, "norm_stats": None}, "neither dataset_statistics.json nor norm_stats"),
        ({**CONFIG, "norm_stats": {}}, "holds no statistics"),
    ],
)
def test_a_config_that_is_not_of_openvla_is_refused(
    tmp_path: Path, config: dict[str, Any], match: str
) -> None:
    with pytest.raises(WorkerError, match=match):
        make(write(tmp_path / "a", config), unnorm_key="bridge_orig")


def test_a_directory_that_is_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match="is not there, wanted a folder"):
        make(tmp_path / "nowhere")
    with pytest.raises(WorkerError, match=r"holds no config.json"):
        make(tmp_path)
    (tmp_path / "adapter_config.json").write_text("{}")
    with pytest.raises(WorkerError, match=r"is a LoRA adapter; .* --set adapter="):
        make(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(WorkerError, match=r"config.json cannot be read"):
        make(tmp_path)
    with pytest.raises(WorkerError, match="give checkpoint=VALUE, with --set"):
        make_policy(find_model("openvla"))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("dtype", "int4"),
        ("quantise", "q4"),
        ("center_crop", "true"),
        ("template", "v02"),
        ("dt_s", "soon"),
    ],
)
def test_an_option_that_cannot_be_says_what_can(tmp_path: Path, option: str, value: str) -> None:
    with pytest.raises(WorkerError, match=rf"{option} is '{value}'"):
        make(write(tmp_path / "a"), **{"unnorm_key": "bridge_orig", option: value})
