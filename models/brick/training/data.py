"""Training data: shards of generate.py, situations without images, and the ground truth."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from geometry import blind
from net import BRICKS, UNIT_M, Scene
from torch import Tensor

NUMBERS = ("hand", "pose", "objects", "yaw", "orders", "way")
KEYS = ("front", "wrist", "front_px", "wrist_px", *NUMBERS)
VALIDATION = 10
"""Every tenth shard is kept for validation."""
BLIND = 2500
"""Situations that a process draws at a time."""


class Data:
    """Shards in memory.

    Args:
        folder: of the shards.
        validation: only the shards kept from training.
        part: this process's share is every `parts`-th shard from here on.
        parts: how many processes share them.
    """

    def __init__(
        self, folder: Path, *, validation: bool = False, part: int = 0, parts: int = 1
    ) -> None:
        self._shards: dict[str, list[Tensor]] = {key: [] for key in KEYS}
        paths = [p for p in sorted(folder.glob("*.npz")) if _is_kept(p) == validation]
        if not paths:
            raise SystemExit(f"{folder} has no shards for this; make some with generate.py")
        for path in paths if validation else paths[part::parts]:
            with np.load(path) as shard:
                for key in KEYS:
                    self._shards[key].append(torch.from_numpy(shard[key]))
        self._ends = np.cumsum([len(each) for each in self._shards["hand"]])

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def take(self, indices: np.ndarray, keys: tuple[str, ...] = KEYS) -> dict[str, Tensor]:
        """The samples of these indices."""
        shard = np.searchsorted(self._ends, indices, side="right")
        row = indices - np.where(shard > 0, self._ends[shard - 1], 0)
        places = list(zip(shard.tolist(), row.tolist(), strict=True))
        return {key: torch.stack([self._shards[key][s][r] for s, r in places]) for key in keys}


def _is_kept(path: Path) -> bool:
    return int(path.stem.rsplit("-", 1)[1]) % VALIDATION == 0


def situations(count: int, seed: int, processes: int) -> dict[str, Tensor]:
    """`count` situations without images, see `geometry.numbers`."""
    seeds = [(seed, 0xB11D, number) for number in range(-(-count // BLIND))]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        parts = list(pool.map(partial(blind, BLIND), seeds))
    return {key: torch.from_numpy(np.concatenate([p[key] for p in parts])) for key in parts[0]}


def truth(batch: dict[str, Tensor]) -> Scene:
    """The true scene, in the form of `net.Scene`."""
    pose, objects = batch["pose"], batch["objects"]
    yaw = pose[:, 3]
    way = objects - pose[:, None, :3]
    cos, sin = torch.cos(yaw)[:, None], torch.sin(yaw)[:, None]
    x, y = cos * way[..., 0] + sin * way[..., 1], cos * way[..., 1] - sin * way[..., 0]
    turn = 4 * (batch["yaw"] - yaw[:, None])
    place = torch.stack([x, y, way[..., 2]], -1) / UNIT_M
    bricks = torch.cat(
        [place[:, :BRICKS], torch.cos(turn)[..., None], torch.sin(turn)[..., None]], -1
    )
    return Scene(bricks, place[:, BRICKS, :2])


class Weather:
    """Random light, colours and noise for images. Noise is cut out of a stock: drawing is slow."""

    def __init__(self, seed: int) -> None:
        self._stock = torch.randn(1 << 22, generator=torch.Generator().manual_seed(seed))

    def __call__(self, rgb: Tensor) -> Tensor:
        """(B, h, w, 3) uint8 to (B, 3, h, w) about zero."""
        count = len(rgb)
        picture = rgb.permute(0, 3, 1, 2).contiguous().float()
        gain = 1 + 0.12 * torch.randn(count, 1, 1, 1) + 0.05 * torch.randn(count, 3, 1, 1)
        light = 0.03 * torch.randn(count, 1, 1, 1)
        picture.mul_(gain / 255.0).add_(light)
        at = int(torch.randint(len(self._stock) - picture.numel(), ()))
        grain = self._stock[at : at + picture.numel()].view_as(picture)
        picture.addcmul_(grain, 0.015 * torch.rand(count, 1, 1, 1))
        return picture.clamp_(0, 1).sub_(0.5)
