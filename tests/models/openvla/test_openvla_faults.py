"""Damaged, incomplete and foreign weights: an error that names what is wrong, never an action."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("timm", reason="needs OpenVLA's environment: make test-models")
import tiny_openvla
import torch
from safetensors.torch import load_file, save_file
from tiny_openvla import FIRST_ACTION, Parts

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

LAST = "model-00003-of-00003.safetensors"
HEAD = "language_model.lm_head.weight"
NORM = "language_model.model.norm.weight"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("openvla") / "tiny"
    tiny_openvla.write(path)
    return path


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "tiny"))


def load(folder: Path, **options: str) -> Any:
    given = {"unnorm_key": "bridge_orig", "device": "cpu", **options}
    policy: Any = make_policy(find_model("openvla"), {"checkpoint": str(folder), **given})
    policy.load()
    return policy


def change(folder: Path, edit: Callable[[dict[str, Any]], None], file: str = LAST) -> None:
    content = load_file(folder / file)
    edit(content)
    save_file(content, folder / file, {"format": "pt"})
    index = json.loads((folder / "model.safetensors.index.json").read_text())
    places = {name: at for name, at in index["weight_map"].items() if at != file}
    index["weight_map"] = places | dict.fromkeys(content, file)
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))


def test_a_missing_file_of_weights_is_named(folder: Path) -> None:
    (folder / LAST).unlink()
    with pytest.raises(WorkerError, match=rf"lacks 1 of 3 files of weights: {LAST}"):
        load(folder)


def test_a_file_that_was_cut_off_is_named(folder: Path) -> None:
    content = (folder / LAST).read_bytes()
    (folder / LAST).write_bytes(content[: len(content) // 2])
    with pytest.raises(WorkerError, match=rf"{LAST} is damaged or was not copied whole"):
        load(folder)


def test_a_file_of_nonsense_is_named(folder: Path) -> None:
    (folder / LAST).write_bytes(b"version https://example.org/pointer\n" * 4)
    with pytest.raises(WorkerError, match=rf"{LAST} is damaged or was not copied whole"):
        load(folder)


def test_a_tensor_that_the_index_promises_and_no_file_has_is_named(folder: Path) -> None:
    content = load_file(folder / LAST)
    del content[NORM]
    save_file(content, folder / LAST)
    with pytest.raises(WorkerError, match=rf"(?s){LAST} is damaged.*{NORM}"):
        load(folder)


def test_a_tensor_that_is_in_neither_index_nor_file_is_named(folder: Path) -> None:
    change(folder, lambda content: content.pop(NORM))
    with pytest.raises(WorkerError, match=rf"not those of its config: it lacks {NORM}"):
        load(folder)


def test_a_tensor_that_nobody_wants_is_named(folder: Path) -> None:
    change(folder, lambda content: content.update({"action_head.weight": torch.zeros(3)}))
    with pytest.raises(WorkerError, match=r"what is not of it, action_head.weight"):
        load(folder)


def test_a_tensor_of_another_shape_is_named_with_both(folder: Path) -> None:
    change(folder, lambda content: content.update({NORM: torch.ones(63)}))
    with pytest.raises(WorkerError, match=rf"{NORM} has shape \(63,\).* it is \(64,\)"):
        load(folder)


def test_weights_that_are_not_numbers_are_named(folder: Path) -> None:
    def spoil(content: dict[str, Any]) -> None:
        content[NORM][5] = float("nan")

    change(folder, spoil)
    with pytest.raises(WorkerError, match=rf"{NORM} holds NaN or infinity"):
        load(folder)


def test_weights_stored_quantised_are_refused(folder: Path) -> None:
    change(folder, lambda content: content.update({NORM: torch.ones(64, dtype=torch.int8)}))
    with pytest.raises(WorkerError, match=r"stored quantised .* --set quantise=nf4"):
        load(folder)


def test_pickled_weights_are_not_read(folder: Path) -> None:
    (folder / "model.safetensors.index.json").unlink()
    (folder / "pytorch_model.bin").write_bytes(b"")
    with pytest.raises(WorkerError, match=r"are pickles and are not read"):
        load(folder)


def test_an_index_cannot_lead_out_of_the_directory(folder: Path) -> None:
    index = {"weight_map": {NORM: "../elsewhere.safetensors"}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    with pytest.raises(WorkerError, match="not beside it"):
        load(folder)


def test_one_file_instead_of_many_is_read_as_well(folder: Path) -> None:
    content = {}
    for file in sorted(folder.glob("*.safetensors")):
        content |= load_file(file)
        file.unlink()
    (folder / "model.safetensors.index.json").unlink()
    save_file(content, folder / "model.safetensors")
    policy = load(folder)
    assert policy.infer(example_observation(policy.spec)).raw["action_tokens"]


def test_a_directory_without_its_tokenizer_is_refused(folder: Path) -> None:
    (folder / "tokenizer.json").unlink()
    with pytest.raises(WorkerError, match=r"tokenizer.json cannot be used"):
        load(folder)


def test_a_device_that_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(WorkerError, match=r"device 'cuda:99' cannot be used"):
        load(folder, device="cuda:99")


def test_a_config_of_another_architecture_is_refused(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["timm_model_ids"][0] = "vit_of_tomorrow"
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(WorkerError, match=r"timm cannot make 'vit_of_tomorrow'"):
        load(folder)


def test_an_answer_that_is_no_action_is_refused(tmp_path: Path) -> None:
    parts = Parts()
    with torch.no_grad():
        parts.llama.lm_head.weight[FIRST_ACTION:] = 0
        parts.llama.lm_head.weight[:FIRST_ACTION].normal_()
    tiny_openvla.write(tmp_path / "talks", parts)
    policy = load(tmp_path / "talks")
    with pytest.raises(SpecError, match=r"actions are 31744 to 31999"):
        policy.infer(example_observation(policy.spec))


def test_encoders_that_see_nothing_are_refused(tmp_path: Path) -> None:
    parts = Parts()
    with torch.no_grad():
        for encoder in parts.encoders:
            encoder.patch_embed.proj.weight.zero_()
    tiny_openvla.write(tmp_path / "blind", parts)
    with pytest.raises(WorkerError, match="answer alike whatever the picture is"):
        load(tmp_path / "blind")


def test_a_network_that_overflows_is_refused(tmp_path: Path) -> None:
    parts = Parts()
    with torch.no_grad():
        parts.projector[-1].weight.fill_(3e38)
    tiny_openvla.write(tmp_path / "hot", parts)
    with pytest.raises(WorkerError, match=r"computes NaN or infinity; try --set dtype=float32"):
        load(tmp_path / "hot")


def test_a_prompt_longer_than_the_model_reads_is_refused(whole: Path) -> None:
    policy = load(whole)
    with pytest.raises(SpecError, match="more than the model reads"):
        policy.infer(example_observation(policy.spec, prompt="up " * 800))


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({"use_dora": True}, "not a plain LoRA"),
        ({"peft_type": "IA3"}, "not a plain LoRA"),
        ({"bias": "all"}, "not a plain LoRA"),
        ({"r": 0}, "wanted r and lora_alpha"),
    ],
)
def test_adapters_of_other_kinds_are_refused(
    whole: Path, tmp_path: Path, config: dict[str, Any], match: str
) -> None:
    adapter = write_adapter(tmp_path / "adapter", {}, config)
    with pytest.raises(WorkerError, match=match):
        load(whole, adapter=str(adapter))


Q = "base_model.model.language_model.model.layers.0.self_attn.q_proj"


@pytest.mark.parametrize(
    ("tensors", "match"),
    [
        ({f"{Q}.lora_A.weight": (4, 64)}, "lora_B.weight is missing"),
        ({f"{Q}.lora_A.weight": (4, 63), f"{Q}.lora_B.weight": (64, 4)}, r"is \(64, 4\) times"),
        ({"base_model.model.x.lora_A.weight": (4, 4)}, "not for this model"),
        ({"base_model.model.x.weight": (4, 4)}, "not a part of a LoRA layer"),
    ],
)
def test_an_adapter_that_does_not_fit_is_refused(
    whole: Path, tmp_path: Path, tensors: dict[str, tuple[int, int]], match: str
) -> None:
    adapter = write_adapter(tmp_path / "adapter", tensors, {})
    with pytest.raises(WorkerError, match=match):
        load(whole, adapter=str(adapter))


def test_an_adapter_without_its_files_is_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r"holds no adapter_config.json"):
        load(whole, adapter=str(tmp_path))


def write_adapter(folder: Path, shapes: dict[str, tuple[int, int]], config: dict[str, Any]) -> Path:
    folder.mkdir()
    plain = {"peft_type": "LORA", "r": 4, "lora_alpha": 8, "bias": "none"}
    (folder / "adapter_config.json").write_text(json.dumps({**plain, **config}))
    tensors = {name: torch.zeros(shape) for name, shape in shapes.items()}
    save_file(tensors, folder / "adapter_model.safetensors")
    return folder
