"""Folders that are given as a LeRobot checkpoint: the policy is found, or what to do is said."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

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
