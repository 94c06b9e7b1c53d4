"""OpenVLA-OFT (Kim, Finn, Liang, 2025): a chunk of steps from one pass through Llama.

The positions of all the chunk's numbers are processed at once, every token attends to every other
one, and a small network regresses the numbers from Llama's outputs there. The other weights are
laid out as those of OpenVLA; the head and the projector of the robot's state are files of their
own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from vla_zenoh_model_openvla.chunk_files import ChunkFiles
from vla_zenoh_model_openvla.network import Network
from vla_zenoh_model_openvla.statistics import AXES

from vla_zenoh.errors import WorkerError

BLOCKS = 2
STOP_TOKEN = 2


class Block(nn.Module):
    """A residual layer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ffn = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())

    def forward(self, features: Tensor) -> Tensor:
        """(..., width) from the same shape."""
        return features + self.ffn(features)


class Head(nn.Module):
    """From Llama's outputs at a step's seven positions to its seven numbers in [-1, 1]."""

    def __init__(self, read: int) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(read * AXES)
        self.fc1 = nn.Linear(read * AXES, read)
        self.mlp_resnet_blocks = nn.ModuleList(Block(read) for _ in range(BLOCKS))
        self.layer_norm2 = nn.LayerNorm(read)
        self.fc2 = nn.Linear(read, AXES)

    def forward(self, places: Tensor) -> Tensor:
        """(n, steps, 7) of (n, steps * 7, read)."""
        rows = places.reshape(len(places), -1, places.shape[-1] * AXES)
        features = torch.relu(self.fc1(self.layer_norm1(rows)))
        for block in self.mlp_resnet_blocks:
            features = block(features)
        return self.fc2(self.layer_norm2(features))


class StateProjector(nn.Module):
    """The robot's state as one more token."""

    def __init__(self, size: int, read: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(size, read), nn.Linear(read, read)

    def forward(self, state: Tensor) -> Tensor:
        """(n, read) of (n, size)."""
        return self.fc2(nn.functional.gelu(self.fc1(state)))


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What OFT adds to a network.

    Args:
        head: of the actions.
        state: of the robot's state, where the policy reads it.
        steps: of a chunk.
    """

    head: Head
    state: StateProjector | None
    steps: int

    @torch.inference_mode()
    def act_all(
        self,
        network: Network,
        prompts: Sequence[Sequence[int]],
        pictures: Sequence[Sequence[Tensor]],
        states: Sequence[Sequence[float]] | None,
    ) -> Tensor:
        """(n, steps, 7) numbers about [-1, 1].

        Args:
            network: its eyes, projector and Llama.
            prompts: tokens of each of n prompts.
            pictures: for each camera, n images for each encoder, see `Eyes.forward`.
            states: normalised, n of them, where the policy reads it.

        Raises:
            WorkerError: the network computes NaN.
        """
        seen = [network.vision_backbone(pixels) for pixels in pictures]
        # Before the projector, which treats every patch alike: one pass for all images.
        patches = network.projector(torch.cat(seen, dim=1))
        if self.state is not None:
            rows = torch.tensor(list(states or ()), device=network.device, dtype=network.dtype)
            patches = torch.cat([patches, self.state(rows)[:, None]], dim=1)
        read = network.read_all([[*ids, STOP_TOKEN] for ids in prompts], patches)
        before = read.embeddings
        places = before.new_zeros(len(before), self.steps * AXES, before.shape[-1])
        # The prompts all end with the stop token, whatever their length.
        before = torch.cat([before[:, :-1], places, before[:, -1:]], dim=1)
        count = before.shape[1]
        # Every token attends to every other one of its robot.
        out = network.language_model.model(
            inputs_embeds=before, use_cache=False, **read.places(0, count, causal=False)
        ).last_hidden_state
        # The output for a position is one before it, as for next tokens.
        first = count - 1 - places.shape[1] - 1
        numbers = self.head(out[:, first : first + places.shape[1]]).float()
        if not torch.isfinite(numbers).all():
            raise WorkerError("the network computes NaN or infinity; try --set dtype=float32")
        return numbers


def load_chunk_head(files: ChunkFiles, network: Network, steps: int) -> ChunkHead:
    """Read head and projector.

    Raises:
        WorkerError: they are damaged, of another kind or of another size.
    """
    width = network.language_model.config.hidden_size
    weights = _read(files.head)
    if not all(name.startswith("model.") for name in weights):
        raise WorkerError(f"{files.head.name} is not a head that regresses actions (L1)")
    head = Head(width)
    _give(head, {name.removeprefix("model."): w for name, w in weights.items()}, files.head)
    state = None
    if files.state is not None:
        weights = _read(files.state)
        first = weights.get("fc1.weight")
        if first is None or first.ndim != 2:
            raise WorkerError(f"{files.state.name} is not a projector of the robot's state")
        state = StateProjector(first.shape[1], width)
        _give(state, weights, files.state)
        state.to(network.device, network.dtype).requires_grad_(False)
    head.to(network.device, network.dtype).requires_grad_(False)
    return ChunkHead(head, state, steps)


def _read(file: Path) -> dict[str, Tensor]:
    try:
        content: Any = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch and its unpickler raise many kinds
        raise WorkerError(
            f"{file} is damaged or holds more than weights: {str(error)[:200]}"
        ) from error
    fits = isinstance(content, Mapping) and all(torch.is_tensor(w) for w in content.values())
    if not fits:
        raise WorkerError(f"{file} holds something else than weights by name")
    # Training on several GPUs wraps what it saves.
    return {str(name).removeprefix("module."): weight for name, weight in content.items()}


def _give(module: nn.Module, weights: Mapping[str, Tensor], file: Path) -> None:
    try:
        module.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise WorkerError(f"{file}: {str(error)[:300]}") from error
    if not all(bool(torch.isfinite(weight).all()) for weight in weights.values()):
        raise WorkerError(f"{file} holds NaN or infinity")
