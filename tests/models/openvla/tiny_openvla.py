"""A tiny OpenVLA checkpoint with random weights, laid out exactly as the published ones are.

It is made of timm's and transformers' own modules and the published names, not of our network, so
that what is loaded from it is compared with something else. ``python tiny_openvla.py DIR`` makes
one.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import timm
import torch
from safetensors.torch import save_file
from tokenizers import Tokenizer, decoders, models, normalizers, processors
from torch import nn
from transformers import LlamaConfig, LlamaForCausalLM
from transformers.models.llama.modeling_llama import LlamaRotaryEmbedding

DINO, SIGLIP = "vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"
SIZES: dict[str, dict[str, Any]] = {
    DINO: {"embed_dim": 64, "depth": 3, "num_heads": 4},
    SIGLIP: {"embed_dim": 48, "depth": 3, "num_heads": 4},
}
TEXT: dict[str, Any] = {
    "hidden_size": 64,
    "intermediate_size": 128,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "num_key_value_heads": 4,
}
VOCABULARY, PADDED = 32000, 32064
FIRST_ACTION = VOCABULARY - 256
FILES = 3
BRIDGE: dict[str, list[Any]] = {
    "mask": [True] * 6 + [False],
    "q01": [-0.02873, -0.04170, -0.02609, -0.08092, -0.09289, -0.20718, 0.0],
    "q99": [0.02831, 0.04086, 0.04016, 0.08192, 0.07793, 0.20383, 1.0],
}
STATISTICS: dict[str, Any] = {
    "bridge_orig": {"action": BRIDGE, "num_trajectories": 60064, "num_transitions": 2135463},
    "unmasked": {"action": {k: v for k, v in BRIDGE.items() if k != "mask"}},
}


class Parts:
    """The modules of a tiny OpenVLA, for a reference computation."""

    def __init__(self, *, fused: bool = True, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.names = [DINO, SIGLIP] if fused else [SIGLIP]
        self.encoders = [
            timm.create_model(name, pretrained=False, num_classes=0, img_size=224, **SIZES[name])
            for name in self.names
        ]
        seen = sum(SIZES[name]["embed_dim"] for name in self.names)
        read = TEXT["hidden_size"]
        sizes = [(seen, 4 * seen), (4 * seen, read), (read, read)] if fused else []
        self.projector = [nn.Linear(*size) for size in sizes or [(seen, read), (read, read)]]
        self.llama = LlamaForCausalLM(
            LlamaConfig(**TEXT, vocab_size=PADDED, pad_token_id=VOCABULARY)
        )
        with torch.no_grad():
            for module in (*self.encoders, *self.projector, self.llama):
                for name, weight in module.named_parameters():
                    _scatter(name, weight)
            # What is no action is never the most likely token, as after training.
            self.llama.lm_head.weight[:FIRST_ACTION] = 0
            self.llama.lm_head.weight[VOCABULARY:] = 0
        for module in (*self.encoders, *self.projector, self.llama):
            module.to(torch.bfloat16).eval()
        # Not a weight, and not rounded to bfloat16 where a checkpoint is loaded either.
        self.llama.model.rotary_emb = LlamaRotaryEmbedding(self.llama.config)

    def published(self) -> dict[str, torch.Tensor]:
        """Every tensor under the name that the published checkpoints give it."""
        places = ["vision_backbone.featurizer.", "vision_backbone.fused_featurizer."]
        out: dict[str, torch.Tensor] = {}
        for place, encoder in zip(places, self.encoders, strict=False):
            for name, tensor in encoder.state_dict().items():
                out[place + name.replace(".gamma", ".scale_factor")] = tensor
        for number, layer in enumerate(self.projector, start=1):
            for name, tensor in layer.state_dict().items():
                out[f"projector.fc{number}.{name}"] = tensor
        for name, tensor in self.llama.state_dict().items():
            out[f"language_model.{name}"] = tensor
        return {name: tensor.contiguous().clone() for name, tensor in out.items()}

    def in_float(self) -> Parts:
        """The same with all computation in float32."""
        for module in (*self.encoders, *self.projector, self.llama):
            module.float()
        return self


def _scatter(name: str, weight: nn.Parameter) -> None:
    """Random numbers large enough that all layers, and the picture, matter in what comes out."""
    if weight.ndim > 1:
        inside = weight[0].numel()
        weight.normal_(0.0, 1.5 / math.sqrt(inside) if "embed_tokens" not in name else 1.0)
    elif "gamma" in name or ("norm" in name and name.endswith("weight")):
        weight.uniform_(0.5, 1.5)
    else:
        weight.normal_(0.0, 0.1)


def config(*, fused: bool = True) -> dict[str, Any]:
    """``config.json``, with the published fields and the sizes of the copy."""
    names = [DINO, SIGLIP] if fused else [SIGLIP]
    return {
        "arch_specifier": "no-align+fused-gelu-mlp" if fused else "no-align+gelu-mlp",
        "architectures": ["OpenVLAForActionPrediction"],
        "auto_map": {"AutoConfig": "configuration_prismatic.OpenVLAConfig"},
        "hf_llm_id": "meta-llama/Llama-2-7b-hf" if fused else "lmsys/vicuna-7b-v1.5",
        "image_resize_strategy": "resize-naive",
        "image_sizes": [224] * len(names),
        "llm_backbone_id": "llama2-7b-pure" if fused else "vicuna-v15-7b",
        "llm_max_length": 2048,
        "model_type": "openvla",
        "n_action_bins": 256,
        "norm_stats": STATISTICS,
        "output_projector_states": False,
        "pad_to_multiple_of": 64,
        "pad_token_id": VOCABULARY,
        "text_config": {
            "model_type": "llama",
            "pad_token_id": VOCABULARY,
            "torch_dtype": "bfloat16",
            "vocab_size": PADDED,
            **TEXT,
        },
        "timm_model_ids": names,
        "timm_override_act_layers": [None] * len(names),
        "timm_model_args": [SIZES[name] for name in names],
        "torch_dtype": "bfloat16",
        "transformers_version": "4.40.1",
        "use_fused_vision_backbone": fused,
        "vision_backbone_id": "dinosiglip-vit-so-224px" if fused else "siglip-vit-so400m",
    }


def tokenizer() -> Tokenizer:
    """Llama's kind of tokenizer with its special tokens, and one token for each letter."""
    blank = "\u2581"
    letters = [chr(code) for code in range(33, 127)]
    pieces = {"<unk>": 0, "<s>": 1, "</s>": 2}
    pieces |= {f"<0x{byte:02X}>": byte + 3 for byte in range(256)}
    pieces |= {f"piece{number}": number for number in range(259, 29871)}
    pieces[blank] = 29871
    pieces |= {letter: 29872 + index for index, letter in enumerate(letters)}
    taken = len(pieces)
    pieces |= {f"piece{number}": number for number in range(taken, VOCABULARY)}
    made = Tokenizer(models.BPE(pieces, [], unk_token="<unk>", fuse_unk=True, byte_fallback=True))
    made.normalizer = normalizers.Sequence(
        [normalizers.Prepend(blank), normalizers.Replace(" ", blank)]
    )
    made.post_processor = processors.TemplateProcessing(
        single="<s> $A", special_tokens=[("<s>", 1)]
    )
    made.decoder = decoders.Sequence([decoders.Replace(blank, " "), decoders.ByteFallback()])
    made.add_special_tokens(["<unk>", "<s>", "</s>", "<PAD>"])
    return made


def write(folder: Path, parts: Parts | None = None, *, statistics: bool = True) -> Parts:
    """Write a checkpoint.

    Args:
        folder: is made.
        parts: its modules; None: new ones.
        statistics: with ``dataset_statistics.json`` beside the weights, as fine-tuning leaves it.
    """
    parts = parts or Parts()
    folder.mkdir(parents=True)
    tensors = parts.published()
    names = list(tensors)
    each = math.ceil(len(names) / FILES)
    places: dict[str, str] = {}
    for number in range(FILES):
        file = f"model-{number + 1:05d}-of-{FILES:05d}.safetensors"
        own = names[number * each : (number + 1) * each]
        save_file({name: tensors[name] for name in own}, folder / file, {"format": "pt"})
        places |= dict.fromkeys(own, file)
    size = sum(tensor.nbytes for tensor in tensors.values())
    index = {"metadata": {"total_size": size}, "weight_map": places}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index, indent=1))
    (folder / "config.json").write_text(json.dumps(config(fused=len(parts.encoders) > 1)))
    tokenizer().save(str(folder / "tokenizer.json"))
    if statistics:
        (folder / "dataset_statistics.json").write_text(json.dumps(STATISTICS))
    return parts


if __name__ == "__main__":
    write(Path(sys.argv[1]))
