"""The network of OpenVLA on current torch, timm and transformers: encoders, projector, Llama.

Names of parameters are those of the published checkpoints. Nothing of a checkpoint is executed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import timm
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM
from vla_zenoh_model_openvla.checkpoint import Backbone, Checkpoint

from vla_zenoh.errors import WorkerError, in_words

PROJECTOR_GROWTH = 4
"""Width of the projector's first layer after two encoders, as a multiple of its input."""


class Eyes(nn.Module):
    """One or two image encoders whose features are concatenated.

    Args:
        backbones: architectures.
    """

    def __init__(self, backbones: Sequence[Backbone]) -> None:
        super().__init__()
        self.featurizer = _encoder(backbones[0])
        self.fused_featurizer = _encoder(backbones[1]) if len(backbones) > 1 else None
        self.sides = [backbone.side for backbone in backbones]
        counts = {encoder.patch_embed.num_patches for encoder in self.encoders()}
        if len(counts) > 1:
            raise WorkerError(f"encoders that cut an image into {sorted(counts)} patches")
        self.patches: int = counts.pop()

    def encoders(self) -> list[Any]:
        """In the order of the image's channels."""
        return [self.featurizer] + ([self.fused_featurizer] if self.fused_featurizer else [])

    @property
    def width(self) -> int:
        """Number of features of each patch."""
        return sum(encoder.embed_dim for encoder in self.encoders())

    def look(
        self, rgb: NDArray[np.uint8], *, device: torch.device, dtype: torch.dtype
    ) -> list[Tensor]:
        """One normalised (1, 3, S, S) image for each encoder, from one (H, W, 3) uint8 RGB."""
        return [
            _normalised(_square(rgb, side), encoder.pretrained_cfg).to(device, dtype)
            for encoder, side in zip(self.encoders(), self.sides, strict=True)
        ]

    def forward(self, pixels: Sequence[Tensor]) -> Tensor:
        """(n, patches, width) from n normalised (n, 3, S, S) images for each encoder."""
        seen = [
            # The last block is left out, as in training: its features are made for its own task.
            encoder.get_intermediate_layers(picture, n=[len(encoder.blocks) - 2])[0]
            for encoder, picture in zip(self.encoders(), pixels, strict=True)
        ]
        return torch.cat(seen, dim=2)


def _square(rgb: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    picture = Image.fromarray(rgb).resize((side, side), Image.Resampling.BICUBIC)
    return np.asarray(picture, np.uint8)


def _normalised(rgb: NDArray[np.uint8], trained: Mapping[str, Any]) -> Tensor:
    mean, std = (torch.tensor(trained[name]).view(1, 3, 1, 1) for name in ("mean", "std"))
    # Copied, because Pillow's arrays are read-only.
    return (torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None] / 255 - mean) / std


def _encoder(backbone: Backbone) -> nn.Module:
    try:
        return timm.create_model(
            backbone.name,
            pretrained=False,
            num_classes=0,
            img_size=backbone.side,
            act_layer=backbone.activation,
            **backbone.arguments,
        )
    except (RuntimeError, TypeError, ValueError, AssertionError) as error:
        raise WorkerError(f"timm cannot make {backbone.name!r}: {in_words(error)}") from error


class Projector(nn.Module):
    """From the encoders' features to Llama's embeddings; deeper for two encoders than for one."""

    def __init__(self, seen: int, read: int, *, deep: bool) -> None:
        super().__init__()
        first = PROJECTOR_GROWTH * seen if deep else read
        self.fc1 = nn.Linear(seen, first)
        self.fc2 = nn.Linear(first, read)
        self.fc3 = nn.Linear(read, read) if deep else None

    def forward(self, features: Tensor) -> Tensor:
        """(n, patches, read) of (n, patches, seen)."""
        out = self.fc2(nn.functional.gelu(self.fc1(features)))
        return out if self.fc3 is None else self.fc3(nn.functional.gelu(out))


class Network(nn.Module):
    """Images and prompt in, action tokens out.

    Args:
        checkpoint: sizes; weights come later, see `load.load_network`.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        try:
            text = LlamaConfig(**checkpoint.text)
            self.language_model = LlamaForCausalLM(text)
        except (RuntimeError, TypeError, ValueError) as error:
            raise WorkerError(f"text_config of {checkpoint.folder}: {in_words(error)}") from error
        self.vision_backbone = Eyes(checkpoint.backbones)
        self.projector = Projector(
            self.vision_backbone.width, text.hidden_size, deep=len(checkpoint.backbones) > 1
        )

    @property
    def dtype(self) -> torch.dtype:
        return self.projector.fc1.weight.dtype

    @property
    def device(self) -> torch.device:
        return self.projector.fc1.weight.device

    def read(self, ids: Sequence[int], patches: Tensor) -> Tensor:
        """(1, T + P, width): the prompt's embeddings with the image's patches after the first.

        Args:
            ids: T tokens of the prompt, the first one is the beginning of the text.
            patches: (1, P, width) of the projector.
        """
        words = self.language_model.get_input_embeddings()(
            torch.tensor([list(ids)], device=self.device)
        )
        return torch.cat([words[:, :1], patches.to(words.dtype), words[:, 1:]], dim=1)

    def read_all(self, prompts: Sequence[Sequence[int]], patches: Tensor) -> Prompts:
        """Several prompts, each with the patches (n, P, width) of its own images."""
        each = [self.read(ids, own[None]) for ids, own in zip(prompts, patches, strict=True)]
        return together(each)

    def begin(self, embeddings: Tensor, **places: Tensor) -> tuple[Tensor, DynamicCache]:
        """Read whole prompts; the (n, vocabulary) logits of the next tokens and the cache."""
        return self._step(DynamicCache(), inputs_embeds=embeddings, **places)

    def go_on(
        self, token: Tensor, cache: DynamicCache, **places: Tensor
    ) -> tuple[Tensor, DynamicCache]:
        """Read one more token of each, (n,); returns the same."""
        return self._step(cache, input_ids=token[:, None], **places)

    def _step(self, cache: DynamicCache, **given: Tensor) -> tuple[Tensor, DynamicCache]:
        out = self.language_model(**given, past_key_values=cache, use_cache=True, logits_to_keep=1)
        return out.logits[:, -1], cache

    def act(self, ids: Sequence[int], pixels: Sequence[Tensor], count: int) -> list[int]:
        """What `act_all` answers to one prompt and its image."""
        return self.act_all([ids], pixels, count)[0]

    @torch.inference_mode()
    def act_all(
        self, prompts: Sequence[Sequence[int]], pixels: Sequence[Tensor], count: int
    ) -> list[list[int]]:
        """The `count` most likely tokens after each prompt, each after the ones before it.

        No end-of-text ends it early: an action always has all its numbers.

        Args:
            prompts: n of them.
            pixels: n images for each encoder, see `Eyes.forward`.
            count: of tokens.

        Raises:
            WorkerError: a logit is not a number.
        """
        read = self.read_all(prompts, self.projector(self.vision_backbone(pixels)))
        length = read.embeddings.shape[1]
        logits, cache = self.begin(read.embeddings, **read.places(0, length, causal=True))
        tokens = [best(logits)]
        for place in range(length, length + count - 1):
            where = read.places(place, place + 1, causal=True)
            logits, cache = self.go_on(tokens[-1], cache, **where)
            tokens.append(best(logits))
        return torch.stack(tokens, dim=1).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class Prompts:
    """Prompts of several robots, the shorter ones padded in front, so that all end together.

    Args:
        embeddings: (n, T, width).
        padding: (n,) places in front of each that are none of its own.
    """

    embeddings: Tensor
    padding: Tensor

    def places(self, begin: int, end: int, *, causal: bool) -> dict[str, Tensor]:
        """Llama's arguments for the places from `begin` to `end`: their numbers in each prompt,
        and what each sees: the own places up to itself, or all. Empty: as it does by itself."""
        if causal and not self.padding.any():
            return {}
        device, pad = self.padding.device, self.padding[:, None]
        at, seen = torch.arange(begin, end, device=device), torch.arange(end, device=device)
        # Padding sees itself: of nothing at all there is no mean.
        own = (seen >= pad)[:, None, :] | (seen == at[:, None])[None]
        if causal:
            own = own & (seen <= at[:, None])[None]
        mask = torch.zeros(own.shape, device=device, dtype=self.embeddings.dtype)
        mask = mask.masked_fill(~own, torch.finfo(mask.dtype).min)
        numbers = (at[None] - pad).clamp(min=0)
        return {"attention_mask": mask[:, None], "position_ids": numbers}


def together(each: Sequence[Tensor]) -> Prompts:
    """Prompts (1, T, width) of any length as one."""
    longest = max(one.shape[1] for one in each)
    padding = [longest - one.shape[1] for one in each]
    rows = [nn.functional.pad(one, (0, 0, pad, 0)) for one, pad in zip(each, padding, strict=True)]
    return Prompts(torch.cat(rows), torch.tensor(padding, device=each[0].device))


def best(logits: Tensor) -> Tensor:
    """(n,) the most likely token of each.

    Raises:
        WorkerError: a logit is not a number, so none is the most likely one.
    """
    most, token = logits.max(dim=-1)
    if not torch.isfinite(most).all():
        raise WorkerError("the network computes NaN or infinity; try --set dtype=float32")
    return token
