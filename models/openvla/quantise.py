"""Llama's layers in 8 or 4 bits (Dettmers et al., 2022 and 2023), for GPUs with little memory.

Image encoders, projector, embeddings and the last layer stay as they are: they are a tenth of the
memory and suffer most.
"""

from __future__ import annotations

import torch
from torch import nn
from vla_zenoh_model_openvla.network import Network

from vla_zenoh.errors import WorkerError, in_words

KINDS = ("none", "int8", "nf4")


def quantise(network: Network, kind: str) -> None:
    """Replace the linear layers of Llama's blocks, one after the other.

    Args:
        network: with its weights, on its device.
        kind: of `KINDS`.

    Raises:
        WorkerError: the library cannot do it here.
    """
    if kind == "none":
        return
    import bitsandbytes

    device, dtype = network.device, network.dtype
    make = {"int8": _int8, "nf4": _nf4}[kind]
    try:
        for block in network.language_model.model.layers:
            for name, layer in list(block.named_modules()):
                if isinstance(layer, nn.Linear):
                    block.set_submodule(name, make(bitsandbytes, layer, dtype).to(device))
    except (RuntimeError, NotImplementedError) as error:
        raise WorkerError(
            f"quantise={kind} does not work on {device}: {in_words(error)}"
        ) from error
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _nf4(library, layer: nn.Linear, dtype: torch.dtype) -> nn.Module:
    out = library.nn.Linear4bit(
        layer.in_features, layer.out_features, bias=False, compute_dtype=dtype, quant_type="nf4"
    )
    # From the CPU, so that .to() is what quantises.
    out.weight = library.nn.Params4bit(
        layer.weight.data.cpu(), requires_grad=False, quant_type="nf4"
    )
    return out


def _int8(library, layer: nn.Linear, dtype: torch.dtype) -> nn.Module:
    out = library.nn.Linear8bitLt(
        layer.in_features, layer.out_features, bias=False, has_fp16_weights=False
    )
    out.weight = library.nn.Int8Params(
        layer.weight.data.cpu(), requires_grad=False, has_fp16_weights=False
    )
    return out
