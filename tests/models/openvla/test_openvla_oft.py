"""OFT's chunks against the same computation written out by hand, without any mask."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("timm", reason="needs OpenVLA's environment: make test-models")
import tiny_openvla
import torch
from test_openvla_numbers import embedded, mosaic
from tiny_openvla import BRIDGE, TEXT, Parts
from torch import Tensor, nn

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import check_steps
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

ATOL = 2e-4
"""Of numbers in [-1, 1], float32 sums in another order."""
KEY, STEPS, STATE_SIZE = "libero_spatial_no_noops", 8, 8
STATISTICS = {
    KEY: {
        "action": BRIDGE,
        "proprio": {"q01": [-1.0] * STATE_SIZE, "q99": [0.5] * STATE_SIZE},
    }
}
HEAD, STATE = "action_head--150000_checkpoint.pt", "proprio_projector--150000_checkpoint.pt"
STATE_TEXT = "position+rotvec+fingers_m"


def weights(layers: dict[str, nn.Module], prefix: str) -> dict[str, Tensor]:
    return {
        f"module.{prefix}{name}.{key}": tensor
        for name, layer in layers.items()
        for key, tensor in layer.state_dict().items()
    }


class Oft:
    """A tiny OFT policy: that of OpenVLA, a head and a projector of the state."""

    def __init__(self) -> None:
        self.parts = Parts()
        torch.manual_seed(5)
        read = TEXT["hidden_size"]
        self.head: dict[str, nn.Module] = {
            "layer_norm1": nn.LayerNorm(read * 7),
            "fc1": nn.Linear(read * 7, read),
            "mlp_resnet_blocks.0.ffn.0": nn.LayerNorm(read),
            "mlp_resnet_blocks.0.ffn.1": nn.Linear(read, read),
            "mlp_resnet_blocks.1.ffn.0": nn.LayerNorm(read),
            "mlp_resnet_blocks.1.ffn.1": nn.Linear(read, read),
            "layer_norm2": nn.LayerNorm(read),
            "fc2": nn.Linear(read, 7),
        }
        self.state: dict[str, nn.Module] = {
            "fc1": nn.Linear(STATE_SIZE, read),
            "fc2": nn.Linear(read, read),
        }

    def write(self, folder: Path) -> None:
        tiny_openvla.write(folder, self.parts)
        (folder / "dataset_statistics.json").write_text(json.dumps(STATISTICS))
        torch.save(weights(self.head, "model."), folder / HEAD)
        torch.save(weights(self.state, ""), folder / STATE)

    @torch.inference_mode()
    def numbers(self, pictures: list[Any], ids: list[int], state: list[float]) -> Any:
        """(STEPS, 7) by hand."""
        first, second = (embedded(self.parts, picture, ids) for picture in pictures)
        told = len(ids) - 1
        seen = [first[:, 1:-told], second[:, 1:-told]]
        row = self.state["fc2"](nn.functional.gelu(self.state["fc1"](torch.tensor([state]))))
        stop = self.parts.llama.model.embed_tokens.weight[2][None, None]
        places = torch.zeros(1, STEPS * 7, TEXT["hidden_size"])
        read = torch.cat([first[:, :1], *seen, row[:, None], first[:, -told:], places, stop], dim=1)
        out = llama_without_mask(self.parts.llama, read)
        end = read.shape[1] - 2
        rows = out[0, end - STEPS * 7 : end].reshape(STEPS, -1)
        h = self.head
        x = torch.relu(h["fc1"](h["layer_norm1"](rows)))
        for block in ("mlp_resnet_blocks.0.ffn", "mlp_resnet_blocks.1.ffn"):
            x = x + torch.relu(h[f"{block}.1"](h[f"{block}.0"](x)))
        return h["fc2"](h["layer_norm2"](x)).numpy()


def llama_without_mask(llama: Any, x: Tensor) -> Tensor:
    """Llama's layers written out, every token seeing every other one."""
    heads, width = TEXT["num_attention_heads"], TEXT["hidden_size"]
    size, length = width // heads, x.shape[1]
    rates = 1.0 / 10000 ** (torch.arange(0, size, 2) / size)
    angles = torch.outer(torch.arange(length), rates).repeat(1, 2)

    def norm(layer: Any, value: Tensor) -> Tensor:
        return layer.weight * value / torch.sqrt(value.pow(2).mean(-1, keepdim=True) + 1e-6)

    def turned(value: Tensor) -> Tensor:
        left, right = value.chunk(2, dim=-1)
        return value * angles.cos() + torch.cat([-right, left], dim=-1) * angles.sin()

    for layer in llama.model.layers:
        y = norm(layer.input_layernorm, x)
        attention = layer.self_attn
        q, k, v = (
            p(y).view(length, heads, size).transpose(0, 1)
            for p in (attention.q_proj, attention.k_proj, attention.v_proj)
        )
        share = torch.softmax(turned(q) @ turned(k).transpose(1, 2) / math.sqrt(size), dim=-1)
        x = x + attention.o_proj((share @ v).transpose(0, 1).reshape(1, length, width))
        y = norm(layer.post_attention_layernorm, x)
        mlp = layer.mlp
        x = x + mlp.down_proj(nn.functional.silu(mlp.gate_proj(y)) * mlp.up_proj(y))
    return norm(llama.model.norm, x)


@pytest.fixture(scope="module")
def oft() -> Oft:
    return Oft()


@pytest.fixture(scope="module")
def whole(oft: Oft, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("oft") / "tiny"
    oft.write(folder)
    oft.parts.in_float()
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "tiny"))


def make(folder: Path, **options: str) -> Any:
    given = {"cameras": "front,wrist", "state": STATE_TEXT, "device": "cpu", **options}
    return make_policy(find_model("openvla"), {"checkpoint": str(folder), **given})


def loaded(folder: Path, **options: str) -> Any:
    policy = make(folder, **options)
    policy.load()
    return policy


def looking(policy: Any, first: int, second: int) -> Any:
    seen = example_observation(policy.spec)
    return replace(seen, images={"front": mosaic(first), "wrist": mosaic(second)})


def test_the_spec_is_that_of_the_data(whole: Path) -> None:
    spec = make(whole).spec
    assert (spec.action.horizon, spec.action.dt_s) == (STEPS, 0.05)
    assert [camera.camera for camera in spec.observation.cameras] == ["front", "wrist"]
    assert spec.observation.state == ("pose", "gripper")
    assert make(whole, horizon="3").spec.action.horizon == 3


@pytest.mark.parametrize("seed", range(3))
def test_a_chunk_is_what_the_computation_by_hand_gives(whole: Path, oft: Oft, seed: int) -> None:
    policy = loaded(whole)
    answer = policy.infer(looking(policy, seed, seed + 10))
    raw = answer.raw
    pictures = [answer.pictures["front"], answer.pictures["wrist"]]
    wanted = oft.numbers(pictures, raw["prompt_tokens"], raw["state"])
    np.testing.assert_allclose(np.array(raw["normalised"]), wanted, atol=ATOL)
    steps = check_steps(policy.spec.action, answer.steps)
    low, high = np.array(BRIDGE["q01"])[:6], np.array(BRIDGE["q99"])[:6]
    units = np.clip(low + (wanted[:, :6] + 1) / 2 * (high - low), -1, 1)
    scale = [policy.spec.action.position_scale_m] * 3 + [1.0] * 3
    np.testing.assert_allclose(steps[:, :6] * scale, units * ([0.05] * 3 + [0.5] * 3), atol=ATOL)
    assert steps.shape == (STEPS, 7)
    assert (np.abs(raw["state"]) <= 1).all()


def test_fewer_steps_than_a_chunk_has_are_its_first(whole: Path) -> None:
    first, all_steps = (
        np.asarray(policy.infer(looking(policy, 1, 2)).steps)
        for policy in (loaded(whole, horizon="3"), loaded(whole))
    )
    np.testing.assert_array_equal(first, all_steps[:3])


def test_each_picture_and_the_state_matter(whole: Path) -> None:
    policy = loaded(whole)
    seen = looking(policy, 0, 1)
    assert seen.pose is not None
    moved = replace(seen, pose=replace(seen.pose, position_m=np.array([-0.5, 0.2, 0.1])))
    answers = [
        np.asarray(policy.infer(each).steps)
        for each in (seen, looking(policy, 2, 1), looking(policy, 0, 2), moved)
    ]
    for other in answers[1:]:
        assert np.abs(answers[0] - other).max() > 1e-6


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"state": "position"}, "state has 8 numbers, 'position' has 3"),
        ({"state": ""}, "state has 8 numbers"),
        ({"chunk": "eight"}, "chunk is 'eight'"),
        ({"horizon": "9"}, "horizon is 9; the model's chunks have 8"),
    ],
)
def test_options_that_do_not_fit_are_named(
    whole: Path, options: dict[str, str], match: str
) -> None:
    with pytest.raises((SpecError, WorkerError), match=match):
        make(whole, **options)


def test_the_length_of_a_chunk_is_asked_for_where_it_is_not_known(folder: Path) -> None:
    (folder / "dataset_statistics.json").write_text(json.dumps({"mine": STATISTICS[KEY]}))
    with pytest.raises(WorkerError, match="how many steps has a chunk of 'mine'"):
        make(folder, dt_s="0.1")


def test_two_heads_are_one_too_many(folder: Path) -> None:
    shutil.copy(folder / HEAD, folder / "action_head--50000_checkpoint.pt")
    with pytest.raises(WorkerError, match="leave one of them there"):
        make(folder)


def test_kinds_that_are_not_read_are_named(folder: Path) -> None:
    (folder / "vision_backbone--150000_checkpoint.pt").write_bytes(b"")
    with pytest.raises(WorkerError, match="with FiLM"):
        make(folder)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ({"noise_predictor.fc1.weight": torch.zeros(1)}, "not a head that regresses actions"),
        ({"model.fc1.weight": torch.zeros(3)}, "Missing key"),
        ([torch.zeros(1)], "something else than weights"),
        ({"model.x": Path("/")}, "holds more than weights"),
    ],
)
def test_a_head_that_is_something_else_is_refused(folder: Path, content: Any, match: str) -> None:
    torch.save(content, folder / HEAD)
    with pytest.raises(WorkerError, match=match):
        loaded(folder)


def test_a_head_that_was_cut_off_is_refused(folder: Path) -> None:
    (folder / HEAD).write_bytes((folder / HEAD).read_bytes()[:500])
    with pytest.raises(WorkerError, match=f"{HEAD} is damaged"):
        loaded(folder)


def test_plain_openvla_takes_one_camera(tmp_path: Path) -> None:
    tiny_openvla.write(tmp_path / "tiny")
    with pytest.raises(WorkerError, match="sees one camera and no state"):
        make(tmp_path / "tiny", unnorm_key="bridge_orig")
