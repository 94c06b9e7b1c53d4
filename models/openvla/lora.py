"""A LoRA adapter (Hu et al., ICLR 2022) as PEFT saves it, added to its base model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from vla_zenoh_model_openvla.checkpoint import ADAPTER_CONFIG, tensors

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.options import read_json

WEIGHTS = "adapter_model.safetensors"
PREFIX = "base_model.model."
DOWN, UP = ".lora_A.weight", ".lora_B.weight"


class Adapter:
    """Low-rank changes of linear layers.

    Args:
        folder: with ``adapter_config.json`` and ``adapter_model.safetensors``.
        device: of the base weights.

    Raises:
        WorkerError: files are missing, or the adapter is not purely additive.
    """

    def __init__(self, folder: Path, device: str) -> None:
        self._folder = folder
        for file in (ADAPTER_CONFIG, WEIGHTS):
            if not (folder / file).is_file():
                raise WorkerError(f"adapter {folder} holds no {file}")
        self._scale = _scale(folder, read_json(folder / ADAPTER_CONFIG))
        self._parts: dict[str, Tensor] = {}
        for name, tensor in tensors({folder / WEIGHTS: None}, device):
            if not name.startswith(PREFIX) or not name.endswith((DOWN, UP)):
                raise WorkerError(f"adapter {folder}: {name} is not a part of a LoRA layer")
            self._parts[name.removeprefix(PREFIX)] = tensor

    def merged(self, name: str, weight: Tensor) -> Tensor:
        """`weight` with what the adapter adds to it, if anything.

        Raises:
            WorkerError: the shapes do not fit.
        """
        layer = name.removesuffix(".weight")
        if layer == name or layer + DOWN not in self._parts:
            return weight
        down = self._parts.pop(layer + DOWN)
        up = self._parts.pop(layer + UP, None)
        if up is None:
            raise WorkerError(f"adapter {self._folder}: {layer}{UP} is missing")
        fits = down.ndim == up.ndim == 2 and up.shape[1] == down.shape[0]
        if not fits or (up.shape[0], down.shape[1]) != tuple(weight.shape):
            raise WorkerError(
                f"adapter {self._folder}: {layer} is {tuple(up.shape)} times {tuple(down.shape)}, "
                f"the layer it changes is {tuple(weight.shape)}"
            )
        return weight.float() + self._scale * (up.float() @ down.float())

    def must_be_used_up(self) -> None:
        """Check that every part of it changed something.

        Raises:
            WorkerError: names a layer that the network does not have.
        """
        if self._parts:
            raise WorkerError(
                f"adapter {self._folder} is not for this model: it changes "
                f"{sorted(self._parts)[0]} and {len(self._parts) - 1} more that are not there"
            )


def _scale(folder: Path, config: Mapping[str, Any]) -> float:
    kind = str(config.get("peft_type", "LORA")).upper()
    unread = [
        name
        for name in (
            "use_dora",
            "fan_in_fan_out",
            "modules_to_save",
            "rank_pattern",
            "alpha_pattern",
            "lora_bias",
        )
        if config.get(name)
    ]
    if kind != "LORA" or unread or config.get("bias", "none") != "none":
        raise WorkerError(
            f"adapter {folder} is not a plain LoRA ({', '.join([kind, *unread])}); "
            "merge it with PEFT and load the result"
        )
    rank, alpha = config.get("r"), config.get("lora_alpha")
    if type(rank) is not int or rank < 1 or not isinstance(alpha, int | float):
        raise WorkerError(f"{folder / ADAPTER_CONFIG}: wanted r and lora_alpha, two numbers")
    return float(alpha) / (math.sqrt(rank) if config.get("use_rslora") else rank)
