"""Time and memory of each stage of an action, compared with transformers' own generation.

The published code makes its tokens by ``generate``; here the same network and the same prompt go
through both, one after the other in the same run.
"""

from __future__ import annotations

import gc
import os
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from torch import Tensor, nn
from vla_zenoh_model_openvla.checkpoint import BACKBONES, Backbone, Checkpoint
from vla_zenoh_model_openvla.load import empty_network, random_weights
from vla_zenoh_model_openvla.network import Network, best
from vla_zenoh_model_openvla.picture import SIDE, trained_form
from vla_zenoh_model_openvla.quantise import quantise
from vla_zenoh_model_openvla.statistics import AXES

from vla_zenoh.errors import WorkerError

WARM_UP = 2
PROMPT_TOKENS = 26
"""Of ``In: What action should the robot take to put the red brick in the box? Out:``."""
SPARE = 1.15
"""Memory of the network during inference, as a multiple of its weights."""
CAMERA = (480, 640, 3)


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage, over all rounds.

    Args:
        name: of it.
        times: how often it runs for an action.
        p50_ms: for one action, all its times together.
        p95_ms: for one action, all its times together.
    """

    name: str
    times: int
    p50_ms: float
    p95_ms: float


@dataclass(frozen=True, slots=True)
class Report:
    """What was measured.

    Args:
        what: which weights.
        device: name of GPU or processor.
        dtype: of weights and computation.
        torch, transformers: versions.
        parameters: numbers in the network.
        stages: in order; ``action`` is all of them in one go, ``generate`` the same action
            by transformers' generation.
        memory_mb: weights of each part, and the most that was in use.
        same_tokens: both ways gave the same action.
    """

    what: str
    device: str
    dtype: str
    torch: str
    transformers: str
    parameters: int
    stages: list[Stage]
    memory_mb: dict[str, float]
    same_tokens: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain types."""
        return asdict(self)


def full_size() -> Checkpoint:
    """The published architecture, without a directory."""
    names = BACKBONES["dinosiglip-vit-so-224px"]
    return Checkpoint(
        folder=Path("openvla-7b"),
        backbones=tuple(Backbone(name, SIDE, None, {}) for name in names),
        text={"vocab_size": 32064, "pad_token_id": 32000},
        text_vocabulary=32000,
        bins=256,
        template="7b",
        statistics={},
        statistics_file="",
    )


def random_network(
    checkpoint: Checkpoint, *, device: str, dtype: torch.dtype, kind: str = "none"
) -> Network:
    """A network of a checkpoint's sizes with random weights.

    Raises:
        WorkerError: the device cannot be used, or lacks memory.
    """
    try:
        torch.zeros(1, device=device)
    except Exception as error:  # torch raises RuntimeError or AssertionError
        raise WorkerError(f"device {device!r} cannot be used: {error}") from error
    network = empty_network(checkpoint)
    numbers = sum(weight.numel() for weight in network.state_dict().values())
    need = numbers * dtype.itemsize * SPARE
    if need > (free := _free_bytes(device)):
        raise WorkerError(
            f"random weights of this size need {need / 1e9:.1f} GB on {device}, "
            f"{free / 1e9:.1f} GB are free"
        )
    random_weights(network, device=device, dtype=dtype)
    quantise(network, kind)
    return network


def _free_bytes(device: str) -> int:
    if device.startswith("cuda"):
        return torch.cuda.mem_get_info(torch.device(device))[0]
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@torch.inference_mode()
def measure(network: Network, what: str, rounds: int) -> Report:
    """Act `rounds` times in stages, in one go, and by transformers' generation, by turns."""
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, CAMERA, dtype=np.uint8)
    ids = [1, *rng.integers(3, 29000, PROMPT_TOKENS - 2).tolist(), 29871]
    if network.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(network.device)
    taken: dict[str, list[float]] = {}
    same = True
    for turn in range(WARM_UP + rounds):
        clock = _Clock(network.device)
        picture = clock("picture: JPEG, resize", trained_form, frame, crop=False)
        eyes, device, dtype = network.vision_backbone, network.device, network.dtype
        pixels = clock("picture to device", eyes.look, picture, device=device, dtype=dtype)
        seen = clock("vision", eyes, pixels)
        patches = clock("projector", network.projector, seen)
        read = network.read(ids, patches)
        token, cache = clock("prefill and first token", _first, network, read)
        for _ in range(AXES - 1):
            token = clock("decode", _next, network, token, cache)
        own = clock("action", network.act, ids, pixels, AXES)
        theirs = clock("generate", _generate, network, ids, pixels)
        same = same and own == theirs
        if turn >= WARM_UP:
            for name, ms in clock.taken_ms.items():
                taken.setdefault(name, []).append(ms)
        gc.collect()
    often = {"decode": AXES - 1}
    stages = [
        Stage(name, often.get(name, 1), *(float(np.percentile(ms, q)) for q in (50, 95)))
        for name, ms in taken.items()
    ]
    return Report(
        what=what,
        device=_device_name(network.device),
        dtype=str(network.dtype).removeprefix("torch."),
        torch=torch.__version__,
        transformers=transformers.__version__,
        parameters=sum(weight.numel() for weight in network.parameters()),
        stages=stages,
        memory_mb=_memory(network),
        same_tokens=same,
    )


class _Clock:
    """Adds up durations; synchronises with the GPU before it reads the clock."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.taken_ms: dict[str, float] = {}

    def __call__(self, name: str, work: Callable[..., Any], *given: Any, **named: Any) -> Any:
        self._wait()
        began_s = time.perf_counter()
        result = work(*given, **named)
        self._wait()
        ms = (time.perf_counter() - began_s) * 1e3
        self.taken_ms[name] = self.taken_ms.get(name, 0.0) + ms
        return result

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def _first(network: Network, read: Tensor) -> tuple[Tensor, Any]:
    logits, cache = network.begin(read)
    return best(logits), cache


def _next(network: Network, token: Tensor, cache: Any) -> Tensor:
    logits, _ = network.go_on(token, cache)
    return best(logits)


def _generate(network: Network, ids: Sequence[int], pixels: Sequence[Tensor]) -> list[int]:
    read = network.read(ids, network.projector(network.vision_backbone(pixels)))
    out = network.language_model.generate(
        inputs_embeds=read,
        attention_mask=torch.ones(read.shape[:2], dtype=torch.long, device=read.device),
        do_sample=False,
        min_new_tokens=AXES,
        max_new_tokens=AXES,
        pad_token_id=network.language_model.config.pad_token_id,
    )
    return [int(token) for token in out[0].tolist()]


def _memory(network: Network) -> dict[str, float]:
    def size(part: nn.Module) -> float:
        return sum(weight.nbytes for weight in part.parameters()) / 1e6

    found = {
        "vision": size(network.vision_backbone),
        "projector": size(network.projector),
        "llama": size(network.language_model),
    }
    if network.device.type == "cuda":
        found["most on the GPU"] = torch.cuda.max_memory_allocated(network.device) / 1e6
    found["most of the process"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return found


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {torch.get_num_threads()} threads"
