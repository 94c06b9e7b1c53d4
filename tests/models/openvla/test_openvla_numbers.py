"""OpenVLA against a plain re-computation of the published algorithm with other code paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("timm", reason="needs OpenVLA's environment: make test-models")
import tiny_openvla
import torch
from numpy.typing import NDArray
from PIL import Image
from tiny_openvla import BRIDGE, Parts

from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation, check_steps
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

PICTURES = 8
STEP_ATOL = 1e-9
"""Metres and radians: rounding of float64."""
LOGITS_RTOL = 1e-3
"""Of float32 sums in another order."""
ROUNDED = 0.501
"""Grey levels: a number and its rounding."""
NEAR = 0.97
"""Correlation of logits from quantised layers with those from whole ones."""
DINO_MEAN, DINO_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
SIGLIP_MEAN = SIGLIP_STD = (0.5, 0.5, 0.5)

Picture = NDArray[np.uint8]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("openvla") / "tiny"
    tiny_openvla.write(path)
    return path


@pytest.fixture(scope="module")
def reference() -> Parts:
    return Parts().in_float()


def loaded(folder: Path, **options: str) -> Any:
    given = {"unnorm_key": "bridge_orig", "device": "cpu", "dtype": "float32", **options}
    policy: Any = make_policy(find_model("openvla"), {"checkpoint": str(folder), **given})
    policy.load()
    return policy


@pytest.fixture(scope="module")
def policy(folder: Path) -> Any:
    return loaded(folder)


def mosaic(seed: int) -> Picture:
    """A picture whose colours differ in large patches."""
    colours = np.random.default_rng(seed).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    return colours.repeat(40, axis=0).repeat(40, axis=1)


def looking(policy: Any, picture: Picture, prompt: str = "put the red brick in the box") -> Any:
    seen: Observation = example_observation(policy.spec, prompt=prompt)
    return replace(seen, images={"front": picture})


def answered(policy: Any, picture: Picture, prompt: str = "lift it") -> dict[str, Any]:
    """What the model says of one inference, with the picture it was shown."""
    answer = policy.infer(looking(policy, picture, prompt))
    assert answer.raw is not None
    return {**answer.raw, "picture": answer.pictures["front"]}


def embedded(parts: Parts, picture: Picture, ids: Sequence[int]) -> Any:
    """What Llama reads, computed from whole forward passes and a hook before the last block."""
    bytes_ = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    scales = [(DINO_MEAN, DINO_STD), (SIGLIP_MEAN, SIGLIP_STD)][-len(parts.encoders) :]
    seen: list[Any] = []
    for encoder, (mean, std) in zip(parts.encoders, scales, strict=True):
        kept: list[Any] = []
        hook = encoder.blocks[-2].register_forward_hook(lambda _m, _i, out, k=kept: k.append(out))
        pixels = (bytes_ - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(std).view(3, 1, 1)
        encoder(pixels)
        hook.remove()
        seen.append(kept[0][:, encoder.num_prefix_tokens :])
    patches = torch.cat(seen, dim=-1)
    for number, layer in enumerate(parts.projector):
        patches = layer(patches if number == 0 else torch.nn.functional.gelu(patches))
    words = parts.llama.model.embed_tokens.weight[list(ids)][None]
    return torch.cat([words[:, :1], patches, words[:, 1:]], dim=1)


@torch.inference_mode()
def generated(parts: Parts, embeddings: Any) -> list[int]:
    """Tokens by transformers' own greedy generation."""
    out = parts.llama.generate(
        inputs_embeds=embeddings,
        attention_mask=torch.ones(embeddings.shape[:2], dtype=torch.long),
        do_sample=False,
        min_new_tokens=7,
        max_new_tokens=7,
        pad_token_id=tiny_openvla.VOCABULARY,
    )
    return out[0].tolist()


@torch.inference_mode()
def recomputed(parts: Parts, embeddings: Any) -> list[int]:
    """Tokens by reading everything anew for each, without any cache."""
    tokens: list[int] = []
    for _ in range(7):
        logits = parts.llama(inputs_embeds=embeddings, use_cache=False).logits[0, -1]
        tokens.append(int(logits.argmax()))
        word = parts.llama.model.embed_tokens.weight[tokens[-1]][None, None]
        embeddings = torch.cat([embeddings, word], dim=1)
    return tokens


@pytest.mark.parametrize("seed", range(PICTURES))
def test_tokens_are_those_of_the_published_algorithm(
    policy: Any, reference: Parts, seed: int
) -> None:
    details = answered(policy, mosaic(seed))
    with torch.inference_mode():
        embeddings = embedded(reference, details["picture"], details["prompt_tokens"])
    assert details["action_tokens"] == generated(reference, embeddings)
    assert details["action_tokens"] == recomputed(reference, embeddings)


def test_what_the_model_reads_is_the_prompt_of_the_training(policy: Any) -> None:
    ids = answered(policy, mosaic(0), "Push the Blue brick")["prompt_tokens"]
    assert (ids[0], ids[-1], ids.count(29871)) == (1, 29871, ids.count(29871))
    text = tiny_openvla.tokenizer().decode(ids[1:-1])
    assert text.strip() == "In: What action should the robot take to push the blue brick?\nOut:"


def test_an_action_is_the_tokens_in_the_units_of_the_data(policy: Any) -> None:
    answer = policy.infer(looking(policy, mosaic(1)))
    step = check_steps(policy.spec.action, answer.steps)[0]
    edges = np.linspace(-1, 1, 256)
    for axis, token in enumerate(answer.raw["action_tokens"]):
        index = min(max(32000 - token - 1, 0), 254)
        number = (edges[index] + edges[index + 1]) / 2
        low, high = BRIDGE["q01"][axis], BRIDGE["q99"][axis]
        wanted = low + (number + 1) / 2 * (high - low) if axis < 6 else min(max(number, 0), 1)
        assert np.asarray(answer.steps)[0, axis] == pytest.approx(wanted, abs=STEP_ATOL)
    assert 0.0 <= step[6] <= 1.0


def test_every_picture_gives_another_action(policy: Any) -> None:
    """The published code on newer libraries answers alike whatever it is shown."""
    actions = {
        tuple(np.asarray(policy.infer(looking(policy, mosaic(seed))).steps)[0])
        for seed in range(PICTURES)
    }
    assert len(actions) == PICTURES


def test_another_prompt_gives_another_action(policy: Any) -> None:
    prompts = ("lift the red brick", "push the blue brick away", "open the gripper")
    seen = {tuple(answered(policy, mosaic(3), prompt)["action_tokens"]) for prompt in prompts}
    assert len(seen) == len(prompts)


def test_the_same_picture_gives_the_same_action(policy: Any) -> None:
    first, second = (np.asarray(policy.infer(looking(policy, mosaic(2))).steps) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_first_version_with_one_encoder_and_its_own_prompt(tmp_path: Path) -> None:
    parts = tiny_openvla.write(tmp_path / "v1", Parts(fused=False)).in_float()
    policy = loaded(tmp_path / "v1")
    details = answered(policy, mosaic(4))
    assert details["prompt"].startswith("A chat between a curious user")
    with torch.inference_mode():
        embeddings = embedded(parts, details["picture"], details["prompt_tokens"])
    assert details["action_tokens"] == generated(parts, embeddings)


def test_bfloat16_computes_in_bfloat16(folder: Path) -> None:
    policy = loaded(folder, dtype="bfloat16")
    policy.infer(looking(policy, mosaic(0)))
    network: Any = policy.network
    assert {p.dtype for p in network.parameters()} == {torch.bfloat16}


@pytest.mark.parametrize("kind", ["int8", "nf4"])
def test_quantised_layers_answer_nearly_alike_with_less_memory(folder: Path, kind: str) -> None:
    whole, small = loaded(folder), loaded(folder, quantise=kind)
    details = answered(whole, mosaic(5))
    ids, picture = details["prompt_tokens"], details["picture"]
    logits, memory = [], []
    for policy in (whole, small):
        network: Any = policy.network
        with torch.inference_mode():
            eyes = network.vision_backbone
            pixels = eyes.look(picture, device=network.device, dtype=network.dtype)
            out, _ = network.begin(network.read(ids, network.projector(eyes(pixels))))
        logits.append(out[0, tiny_openvla.FIRST_ACTION : tiny_openvla.VOCABULARY])
        blocks = network.language_model.model.layers
        memory.append(sum(p.nbytes for p in blocks.parameters()))
    assert torch.corrcoef(torch.stack(logits))[0, 1] > NEAR
    assert memory[1] < 0.5 * memory[0]


def test_resizing_is_that_of_a_known_library() -> None:
    from vla_zenoh_model_openvla.picture import lanczos

    noise = np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    for picture in (noise, mosaic(0)):
        known = [
            # As numbers, because Pillow cuts bytes off between its two passes.
            Image.fromarray(channel).resize((224, 224), Image.Resampling.LANCZOS)
            for channel in picture.astype(np.float32).transpose(2, 0, 1)
        ]
        wanted = np.clip(np.stack([np.asarray(channel) for channel in known], axis=-1), 0, 255)
        assert np.abs(lanczos(picture, 224) - wanted).max() <= ROUNDED


def test_encoders_with_a_larger_side_get_a_larger_picture(policy: Any) -> None:
    network: Any = policy.network
    eyes = network.vision_backbone
    sides, eyes.sides = eyes.sides, [384, 224]
    try:
        large, small = eyes.look(mosaic(0)[:224, :224], device="cpu", dtype=torch.float32)
    finally:
        eyes.sides = sides
    assert large.shape == (1, 3, 384, 384)
    assert small.shape == (1, 3, 224, 224)
    back = large[0].permute(1, 2, 0).numpy() * DINO_STD + DINO_MEAN
    known = Image.fromarray(mosaic(0)[:224, :224]).resize((384, 384), Image.Resampling.BICUBIC)
    assert np.abs(back * 255 - np.asarray(known)).max() <= ROUNDED


# -- LoRA -----------------------------------------------------------------------------------------


def test_an_adapter_is_added_as_peft_adds_it(folder: Path, tmp_path: Path) -> None:
    peft = pytest.importorskip("peft", reason="the reference for adapters")
    parts = Parts().in_float()
    whole = torch.nn.Module()
    whole.vision_backbone = torch.nn.Module()
    whole.vision_backbone.featurizer, whole.vision_backbone.fused_featurizer = parts.encoders
    whole.projector = torch.nn.Module()
    whole.projector.fc1, whole.projector.fc2, whole.projector.fc3 = parts.projector
    whole.language_model = parts.llama
    names = r".*(q_proj|v_proj|down_proj|qkv|projector\.fc2|blocks\.0\.mlp\.fc1)"
    adapted = peft.get_peft_model(
        whole, peft.LoraConfig(r=4, lora_alpha=8, target_modules=names, init_lora_weights=False)
    )
    for name, weight in adapted.named_parameters():
        if "lora_" in name:
            torch.nn.init.normal_(weight, std=0.1)
    adapted.save_pretrained(tmp_path / "adapter")
    adapted.merge_and_unload()

    policy = loaded(folder, adapter=str(tmp_path / "adapter"))
    plain = loaded(folder)
    ours = policy.network.state_dict()
    for name, tensor in parts.published().items():
        name = name.replace(".scale_factor", ".gamma")
        torch.testing.assert_close(ours[name], tensor, rtol=1e-5, atol=1e-6)
    changed = [name for name, t in plain.network.state_dict().items() if not t.equal(ours[name])]
    assert len(changed) == 2 * 3 + 3 + 3 + 1 + 2
    details = answered(policy, mosaic(6))
    with torch.inference_mode():
        embeddings = embedded(parts, details["picture"], details["prompt_tokens"])
    assert details["action_tokens"] == generated(parts, embeddings)
