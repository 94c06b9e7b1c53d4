"""Trains the localisation network with several processes; resumes where it stopped."""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from data import Data, Weather, truth
from encoder import pieces
from lessons import Teller, follow, schedule
from net import STRIDE, UNIT_M, Places, Policy, Scene, normal
from torch import Tensor

WEIGHTS = {"front": 0.15, "wrist": 0.2, "scene": 1.0}
AVERAGE = 0.998
SAVE_S = 120.0
HAND_NOISE = (0.01, 0.01, 0.01, 0.01, 0.01, 0.0, 0.01, 0.01, 0.0)
"""A small motion of the hand between measuring and rendering also moves the image."""
DISTANCES_MM = ((0, 15), (15, 60), (60, 120), (120, 500))
CHECKS, CHECK_BATCH = 6, 100


def spread(px: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Cells (n, K, 4) around each point and their weights; outside the image: nowhere."""
    column, row = px[..., 0] * width - 0.5, px[..., 1] * height - 0.5
    out = (px[..., :2] < 0).any(-1) | (px[..., :2] >= 1).any(-1) | (px[..., 2] < 0.01)
    left, top = column.floor(), row.floor()
    cells, weights = [], []
    for down in (0, 1):
        for right in (0, 1):
            c = (left + right).clamp(0, width - 1)
            r = (top + down).clamp(0, height - 1)
            weight = (1 - (column - left - right).abs()) * (1 - (row - top - down).abs())
            cells.append(torch.where(out, height * width, (r * width + c).long()))
            weights.append(weight.clamp(0, 1))
    return torch.stack(cells, -1), torch.stack(weights, -1)


def map_loss(log_maps: Tensor, px: Tensor, size: torch.Size) -> Tensor:
    """Cross entropy with the true place, shared among the four cells around it."""
    cells, weights = spread(px, size[1] // STRIDE, size[2] // STRIDE)
    return -(log_maps.gather(2, cells) * weights).sum(-1).mean()


def scene_loss(found: Places, real: Scene) -> Tensor:
    """Distance, relative to the distance from the hand: near objects must be exact."""
    far = real.bricks[..., :2].norm(dim=-1, keepdim=True)
    place = ((found.bricks - real.bricks[..., :3]).abs() / (far + 0.25)).mean()
    box_far = real.box.norm(dim=-1, keepdim=True)
    return place + 0.5 * ((found.box - real.box).abs() / (box_far + 0.5)).mean()


def losses_of(net: Policy, batch: dict[str, Tensor], weather: Weather | None) -> dict[str, Tensor]:
    """All losses of one batch, with this augmentation; each with its weight."""
    hand, change = batch["hand"], normal
    if weather is not None:
        hand = hand + torch.randn_like(hand) * torch.tensor(HAND_NOISE)
        change = weather
    found = net.eyes.find(change(batch["front"]), change(batch["wrist"]), hand)
    losses = {
        "front": map_loss(found.maps[0], batch["front_px"], batch["front"].shape),
        "wrist": map_loss(found.maps[1], batch["wrist_px"], batch["wrist"].shape),
        "scene": scene_loss(found, truth(batch)),
    }
    return {name: WEIGHTS[name] * value for name, value in losses.items()}


@dataclass(slots=True)
class State:
    """State of the training, saved now and then."""

    net: Policy
    optimiser: torch.optim.Optimizer
    mean: dict[str, Tensor]
    step: int = 0

    def save(self, path: Path) -> None:
        """Save atomically."""
        part = path.with_suffix(".part")
        torch.save(
            {
                "eyes": self.net.eyes.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "mean": self.mean,
                "step": self.step,
            },
            part,
        )
        part.rename(path)

    def load(self, path: Path) -> None:
        """Load a saved state."""
        saved = torch.load(path, weights_only=True)
        self.net.eyes.load_state_dict(saved["eyes"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.mean, self.step = saved["mean"], saved["step"]


def teach_eyes(net: Policy, args: argparse.Namespace) -> None:
    """Train the eyes with several processes; their weights are in `net` afterwards."""
    resume = args.out / "eyes.pt"
    port = 20_000 + os.getpid() % 20_000
    begin = {key: value.clone() for key, value in net.state_dict().items()}
    if args.processes > 1:
        mp.spawn(_learn, (args, port, resume, begin), nprocs=args.processes)
    else:
        _learn(0, args, port, resume, begin)
    net.eyes.load_state_dict(torch.load(resume, weights_only=True)["mean"])


def _learn(
    rank: int, args: argparse.Namespace, port: int, resume: Path, begin: dict[str, Tensor]
) -> None:
    torch.set_num_threads(1)
    many = args.processes
    if many > 1:
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        dist.init_process_group("gloo", rank=rank, world_size=many)
    net = Policy(len(pieces()) + 2)
    net.load_state_dict(begin)
    looking = [p for n, p in net.eyes.named_parameters() if not n.startswith("turn.")]
    optimiser = torch.optim.AdamW(looking, args.rate, weight_decay=1e-4)
    mean = {key: value.clone() for key, value in net.eyes.state_dict().items()}
    state = State(net, optimiser, mean)
    if resume.exists():
        state.load(resume)
    torch.manual_seed(args.seed * 1000 + rank + state.step)
    random = np.random.default_rng((args.seed, rank, state.step))
    weather = Weather(args.seed)
    data = Data(args.data, part=rank, parts=many)
    check = Data(args.data, validation=True) if rank == 0 else None
    tell = Teller("eyes", args.eyes_steps)
    saved_s = time.monotonic()
    while state.step < args.eyes_steps:
        for group in optimiser.param_groups:
            group["lr"] = args.rate * schedule(state.step, args.eyes_steps)
        losses = losses_of(net, data.take(random.integers(0, len(data), args.batch)), weather)
        optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        if many > 1:
            _share(looking, many)
        torch.nn.utils.clip_grad_norm_(looking, 1.0)
        optimiser.step()
        follow(state.mean, net.eyes, state.step, AVERAGE)
        if check is not None:
            tell(state.step, losses)
        state.step += 1
        if check is not None and (
            time.monotonic() - saved_s > SAVE_S or state.step == args.eyes_steps
        ):
            state.save(resume)
            print(validate(state, check, args.seed), flush=True)
            saved_s = time.monotonic()
    if many > 1:
        dist.barrier()
        dist.destroy_process_group()


def _share(parameters: list[torch.nn.Parameter], many: int) -> None:
    """Give every process the mean of all gradients."""
    flat = torch.cat([p.grad.flatten() for p in parameters if p.grad is not None])
    dist.all_reduce(flat)
    flat /= many
    at = 0
    for p in parameters:
        if p.grad is not None:
            p.grad.copy_(flat[at : at + p.numel()].view_as(p))
            at += p.numel()


@torch.no_grad()
def validate(state: State, data: Data, seed: int) -> str:
    """Errors of the averaged weights on unseen shards: mm, median and 95 %."""
    other = Policy(len(state.net.reader.meaning))
    other.eyes.load_state_dict(state.mean)
    random = np.random.default_rng(seed)
    errors = []
    for _ in range(CHECKS):
        batch = data.take(random.integers(0, len(data), CHECK_BATCH))
        found = other.eyes.find(normal(batch["front"]), normal(batch["wrist"]), batch["hand"])
        real = truth(batch).bricks[..., :2]
        off = (found.bricks[..., :2] - real).norm(dim=-1)
        errors.append(torch.stack([off, real.norm(dim=-1)], -1) * UNIT_M * 1e3)
    off, far = torch.cat(errors).flatten(0, 1).T
    parts = [(a, b, off[(far >= a) & (far < b)]) for a, b in DISTANCES_MM]
    return "  off, by distance in mm: " + ", ".join(
        f"{a}-{b}: {each.median():.1f}/{each.quantile(0.95):.1f}" for a, b, each in parts
    )
