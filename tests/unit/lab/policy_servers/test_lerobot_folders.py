"""Folders that are given as a LeRobot checkpoint: the policy is found, or what to do is said."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.loader import find_model, import_model

ACT = {
    "type": "act",
    "chunk_size": 8,
    "n_action_steps": 8,
    "input_features": {"observation.images.front": {"shape": [3, 96, 128]}},
    "output_features": {"action": {"shape": [7]}},
}


@pytest.fixture(scope="module")
def mapping() -> Any:
    import_model(find_model("lerobot"))
    return import_module("vla_zenoh_model_lerobot.mapping")


@pytest.fixture(scope="module")
def environment(mapping: Any) -> Any:
    return import_module("vla_zenoh_model_lerobot.environment")


@pytest.fixture(scope="module")
def normalisation(mapping: Any) -> Any:
    return import_module("vla_zenoh_model_lerobot.normalisation")


def policy(folder: Path, **changes: Any) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({**ACT, **changes}))
    (folder / "model.safetensors").touch()
    return folder


@pytest.mark.parametrize("below", ["", "checkpoints", "checkpoints/000100", "checkpoints/last"])
def test_the_policy_of_a_training_is_found(environment: Any, tmp_path: Path, below: str) -> None:
    made = policy(tmp_path / "checkpoints" / "000100" / "pretrained_model")
    (tmp_path / "checkpoints" / "last").symlink_to("000100")
    assert environment.policy_folder(tmp_path / below).resolve() == made
    assert environment.policy_folder(made) == made


@pytest.mark.parametrize("below", ["", "checkpoints", "checkpoints/last"])
def test_a_link_that_leads_nowhere_is_named(environment: Any, tmp_path: Path, below: str) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last").symlink_to("000100")
    with pytest.raises(WorkerError, match=r"last is a link to 000100, which is not there"):
        environment.policy_folder(tmp_path / below)


def test_whole_weights_that_were_trained_as_an_adapter_are_taken(
    mapping: Any, tmp_path: Path
) -> None:
    folder = policy(tmp_path / "merged", use_peft=True)
    assert mapping.read_config(folder)["use_peft"]
    mapping.check_weights(folder)


def test_an_adapter_says_what_to_merge_it_with(mapping: Any, tmp_path: Path) -> None:
    folder = policy(tmp_path / "lora")
    (folder / "model.safetensors").unlink()
    (folder / "adapter_model.safetensors").touch()
    (folder / "adapter_config.json").write_text('{"base_model_name_or_path": "lab/base"}')
    with pytest.raises(WorkerError, match=r"adapter \(LoRA\).* weights of lab/base.*merge_and_un"):
        mapping.read_config(folder)


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ((), "it is incomplete; copy or download it again"),
        (("pytorch_model.bin",), "pytorch_model.bin: pickles are not loaded"),
    ],
)
def test_missing_weights_say_why(
    mapping: Any, tmp_path: Path, files: tuple[str, ...], said: str
) -> None:
    folder = policy(tmp_path / "act")
    (folder / "model.safetensors").unlink()
    for name in files:
        (folder / name).touch()
    with pytest.raises(WorkerError, match=said):
        mapping.check_weights(folder)


def test_the_old_format_comes_with_the_command_that_brings_it_up_to_date(
    mapping: Any, tmp_path: Path
) -> None:
    folder = policy(tmp_path / "old")
    with pytest.raises(WorkerError) as error:
        mapping.device_step(folder / "policy_preprocessor.json")
    command = "python -m lerobot.processor.migrate_policy_normalization"
    assert f"{command} --pretrained-path {folder}; " in str(error.value)
    assert f"checkpoint={folder}_migrated" in str(error.value)


# -- the data set of a training -------------------------------------------------------------------
@pytest.fixture(scope="module")
def dataset_options(mapping: Any) -> Any:
    return import_module("vla_zenoh_model_lerobot.dataset").dataset_options


OPTIONS = {"action": "delta", "dt_s": "0.1", "state": "position+rpy", "parts": ""}


def data_set(folder: Path, ours: Any = None, **info: Any) -> Path:
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 20, "robot_type": "x", **info}))
    if ours is not None:
        (folder / "meta" / "vla_zenoh.json").write_text(json.dumps(ours))
    return folder


def test_a_policy_has_the_options_of_the_data_set_that_its_training_names(
    dataset_options: Any, tmp_path: Path
) -> None:
    made = policy(tmp_path / "act")
    assert dataset_options(made, "") == {}, "a policy without a train_config.json"
    (made / "train_config.json").write_text(
        json.dumps({"dataset": {"root": str(tmp_path / "bricks")}})
    )
    assert dataset_options(made, "") == {}, "the data set is not here"
    turned = {"": [1.0, 0.0, 0.0, 0.0]}
    data_set(tmp_path / "bricks", {"options": OPTIONS, "rotation_reference": turned})
    assert dataset_options(made, "") == {**OPTIONS, "rotation_reference": "1.0,0.0,0.0,0.0"}


def test_a_data_set_that_lerobot_recorded_through_our_plug_in_is_known_by_its_robot(
    dataset_options: Any, tmp_path: Path
) -> None:
    made = policy(tmp_path / "act")
    found = dataset_options(made, str(data_set(tmp_path / "ours", robot_type="vla_zenoh")))
    assert (found["action"], found["dt_s"]) == ("joint_position", "0.05")
    assert found["state"] == "joint+gripper_open"


def test_any_other_data_set_says_nothing_and_is_rejected_if_it_is_named(
    dataset_options: Any, tmp_path: Path
) -> None:
    made = policy(tmp_path / "act")
    arms_differ = data_set(tmp_path / "arms", {"options": None})
    for other in (data_set(tmp_path / "others"), arms_differ, tmp_path / "nothing"):
        with pytest.raises(WorkerError, match="no data set of `vla-zenoh dataset export`"):
            dataset_options(made, str(other))


@pytest.mark.parametrize(
    ("mode", "low", "high", "number"),
    [
        ("MEAN_STD", [0.1, 0.2], [0.3, 1e-9], 1),
        ("MEAN_STD", [1e-10, 0.2], [1e-9, 0.1], 0),
        ("MEAN_STD", [90.0, 0.2], [1e-5, 0.1], 0),
        ("MIN_MAX", [0.0, 0.5], [1.0, 0.5000001], 1),
        ("QUANTILES", [0.5, 0.0], [0.5, 1.0], 0),
        ("MEAN_STD", [0.0, 0.0], [1e-4, 1e-5], None),
        ("MIN_MAX", [-3.0, 89.9], [-2.9, 90.0], None),
    ],
)
def test_a_number_that_changed_in_the_data_by_rounding_alone_cannot_be_scaled(
    normalisation: Any, mode: str, low: list[float], high: list[float], number: int | None
) -> None:
    wanted = normalisation.Scaled("observation.state", "STATE", (2,), mode)
    names = normalisation.FIGURES[mode]
    found = dict(zip(names, (np.array(low, np.float32), np.array(high, np.float32)), strict=True))
    why = list(normalisation.faults(wanted, {"observation.state": found}))
    assert len(why) == (number is not None)
    if why:
        assert f"of its number {number} is" in why[0]
        assert "the number never changed in the data" in why[0]
