"""Weights into the network: every tensor once, each checked, none left over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from transformers.models.llama.modeling_llama import LlamaRotaryEmbedding
from vla_zenoh_model_openvla.checkpoint import Checkpoint, shards, tensors
from vla_zenoh_model_openvla.lora import Adapter
from vla_zenoh_model_openvla.network import Network

from vla_zenoh.errors import WorkerError

SHOWN = 4
"""Names of wrong tensors in an error; of the others only the number."""


def empty_network(checkpoint: Checkpoint) -> Network:
    """The network without memory for its weights."""
    with torch.device("meta"):
        return Network(checkpoint).eval()


def load_network(
    checkpoint: Checkpoint,
    *,
    device: str,
    dtype: torch.dtype,
    adapter: Path | None = None,
) -> Network:
    """The network of a checkpoint, ready to act.

    Args:
        checkpoint: of `checkpoint.read_checkpoint`.
        device: as torch names it.
        dtype: of weights and computation.
        adapter: folder of a LoRA adapter that is added to the weights.

    Raises:
        WorkerError: tensors are missing, left over, of another shape, cut off or not finite.
    """
    network = empty_network(checkpoint)
    wanted = network.state_dict()
    added = Adapter(adapter, device) if adapter is not None else None
    loaded: dict[str, Tensor] = {}
    strange: list[str] = []
    for published, given in tensors(shards(checkpoint.folder), device):
        name = _here(published)
        if name is None:
            continue
        if name not in wanted:
            strange.append(published)
            continue
        loaded[name] = _checked(published, given, wanted[name], added).to(dtype)
    _all_there(checkpoint, wanted, loaded, strange)
    if added is not None:
        added.must_be_used_up()
    give(network, loaded, device)
    return network


def give(network: Network, weights: Mapping[str, Tensor], device: str) -> None:
    """Put `weights` into a network that has none, without copying."""
    network.load_state_dict(weights, strict=True, assign=True)
    # Its frequencies are computed, not loaded.
    llama = network.language_model.model
    llama.rotary_emb = LlamaRotaryEmbedding(config=llama.config).to(device)
    network.requires_grad_(False)


def random_weights(network: Network, *, device: str, dtype: torch.dtype, seed: int = 0) -> None:
    """Give an empty network random weights, to measure it without a checkpoint."""
    generator = torch.Generator(device=device).manual_seed(seed)
    weights = {
        name: _random(name, like, generator, device, dtype)
        for name, like in network.state_dict().items()
    }
    give(network, weights, device)


def _random(
    name: str, like: Tensor, generator: torch.Generator, device: str, dtype: torch.dtype
) -> Tensor:
    if like.ndim == 1:
        of_norm = "norm" in name and name.endswith("weight")
        return (torch.ones if of_norm else torch.zeros)(like.shape, device=device, dtype=dtype)
    out = torch.empty(like.shape, device=device, dtype=dtype)
    return out.normal_(0.0, 0.02, generator=generator)


def layers(network: nn.Module) -> Iterator[tuple[str, nn.Linear]]:
    """Every linear layer by name."""
    for name, module in network.named_modules():
        if isinstance(module, nn.Linear):
            yield name, module


def _here(published: str) -> str | None:
    """The name of a published tensor in our network; None: it is computed here."""
    if published.endswith("rotary_emb.inv_freq"):
        return None
    # transformers once renamed parameters that end in gamma, so checkpoints differ from timm.
    if published.endswith(".scale_factor"):
        return published.removesuffix("scale_factor") + "gamma"
    return published


def _checked(name: str, given: Tensor, wanted: Tensor, adapter: Adapter | None) -> Tensor:
    if given.shape != wanted.shape:
        raise WorkerError(
            f"tensor {name} has shape {tuple(given.shape)}; "
            f"by the checkpoint's config it is {tuple(wanted.shape)}"
        )
    if not given.is_floating_point():
        raise WorkerError(
            f"tensor {name} is {given.dtype}; weights that were stored quantised are not read: "
            "take the plain ones and --set quantise=nf4"
        )
    if adapter is not None:
        given = adapter.merged(name, given)
    if not bool(torch.isfinite(given).all()):
        raise WorkerError(f"tensor {name} holds NaN or infinity")
    return given


def _all_there(
    checkpoint: Checkpoint,
    wanted: Mapping[str, Tensor],
    loaded: Mapping[str, Tensor],
    strange: list[str],
) -> None:
    missing = [name for name in wanted if name not in loaded]
    faults = [
        f"{kind} {', '.join(names[:SHOWN])}"
        + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
        for kind, names in (("it lacks", missing), ("it has what is not of it,", strange))
        if names
    ]
    if faults:
        raise WorkerError(
            f"the weights in {checkpoint.folder} are not those of its config: {'; '.join(faults)}"
        )
