"""Trains each part of the network separately; the eyes are trained in eyes.py."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from data import NUMBERS, Data, truth
from encoder import embeddings, pieces
from net import BRICKS, KINDS, MEANING, UNIT_M, Policy, Scene, cut_out, normal
from phrases import NO_TASK, Phrases
from torch import Tensor, nn

SAY_S = 30.0
LEAST_SHARE, WARM_STEPS = 0.01, 100
AVERAGE = 0.998
READER_POOL, READER_BATCH, READER_RATE = 120_000, 192, 3e-3
READER_NOISE = 0.3
TURN_RATE, TURN_BATCH = 2e-3, 192
WILL_RATE, WILL_BATCH, WILL_SEEN = 2e-3, 512, 256
STEP_WEIGHTS = (1.6, 1.6, 1.4, 1.2, 1.0, 0.8, 0.6, 0.5)
GRIP_WEIGHT = 0.4
HAND_NOISE = (0.01, 0.01, 0.006, 0.006, 0.003, 0.0, 0.006, 0.01, 0.0)
"""Noise of the hand's inputs, in the scales of `model.Hand.numbers`."""


def schedule(step: int, steps: int) -> float:
    """Share of the greatest learning rate: linear warm-up, then a cosine."""
    down = LEAST_SHARE + (1 - LEAST_SHARE) * 0.5 * (1 + math.cos(math.pi * step / steps))
    return down * min(1.0, (step + 1) / WARM_STEPS)


class Teller:
    """Prints the progress now and then.

    Args:
        name: of the part that is trained.
        steps: number of steps.
    """

    def __init__(self, name: str, steps: int) -> None:
        self._name, self._steps = name, steps
        self._begin_s = self._told_s = time.monotonic()
        self._sums: dict[str, float] = {}
        self._count = 0

    def __call__(self, step: int, losses: dict[str, Tensor]) -> None:
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value.item()
        self._count += 1
        now = time.monotonic()
        if now - self._told_s > SAY_S or step + 1 == self._steps:
            means = " ".join(f"{n} {v / self._count:.4f}" for n, v in self._sums.items())
            spent = f"{now - self._begin_s:.0f} s"
            print(f"{self._name}: {step + 1} of {self._steps}, {spent}: {means}", flush=True)
            self._told_s, self._sums, self._count = now, {}, 0


def teach(
    part: nn.Module,
    steps: int,
    rate: float,
    lesson: Callable[[int], dict[str, Tensor]],
    name: str,
    *,
    average: bool = False,
) -> None:
    """`steps` steps on the sum of the losses that `lesson` returns."""
    optimiser = torch.optim.AdamW(part.parameters(), rate, weight_decay=1e-4)
    mean = {key: value.clone() for key, value in part.state_dict().items()}
    tell = Teller(name, steps)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = rate * schedule(step, steps)
        losses = lesson(step)
        optimiser.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(part.parameters(), 1.0)
        optimiser.step()
        tell(step, losses)
        if average:
            follow(mean, part, step, AVERAGE)
    if average:
        part.load_state_dict(mean)


@torch.no_grad()
def follow(mean: dict[str, Tensor], part: nn.Module, step: int, average: float) -> None:
    """Update the mean of the last weights."""
    keep = min(average, step / (step + 20))
    for key, value in part.state_dict().items():
        mean[key].mul_(keep).add_(value, alpha=1 - keep)


def teach_reader(net: Policy, steps: int, seed: int) -> None:
    """Train the reader: which properties of embeddings matter, and the order of pieces."""
    random = np.random.default_rng((seed, 77))
    given, reader = embeddings(), net.reader
    pool = [torch.from_numpy(each) for each in Phrases(pieces()).batch(random, READER_POOL)]
    narrow = nn.Linear(given.shape[1], MEANING)

    def meaning(rows: Tensor) -> Tensor:
        return torch.tanh(narrow(rows))

    def lesson(_: int) -> dict[str, Tensor]:
        rows = torch.from_numpy(random.integers(0, len(pool[0]), READER_BATCH))
        tokens, kind, target, onto = (each[rows] for each in pool)
        told = given[tokens]
        # Words that do not occur in training lie near some that do.
        told = meaning(told + READER_NOISE * torch.randn_like(told))
        read = reader.read(told * (tokens != 0)[..., None], tokens)
        task, stack = kind != NO_TASK, onto >= 0
        return {
            "kind": F.cross_entropy(read[0], kind),
            "target": F.cross_entropy(read[1][task], target[task]),
            "onto": F.cross_entropy(read[2][stack], onto[stack]),
        }

    taught = nn.ModuleList([reader, narrow])
    taught.train()
    teach(taught, steps, READER_RATE, lesson, "reader")
    taught.eval()
    with torch.no_grad():
        reader.meaning.copy_((127.0 * meaning(given)).round().to(torch.int8))
        reader.meaning[0] = 0


def teach_turn(net: Policy, data: Data, steps: int, seed: int) -> None:
    """Train the rotation of bricks, from patches cut out at their true places."""
    random = np.random.default_rng((seed, 79))
    parts: list[tuple[Tensor, ...]] = []
    for rows in _in_turn(len(data), 500):
        batch = data.take(rows, (*NUMBERS, "wrist", "wrist_px"))
        picture = batch["wrist"].permute(0, 3, 1, 2).float()
        uv = batch["wrist_px"][:, :BRICKS, :2] + 0.012 * torch.randn(len(rows), BRICKS, 2)
        seen = ((uv > 0.02) & (uv < 0.98)).all(-1) & (batch["wrist_px"][:, :BRICKS, 2] > 0.02)
        seen = seen.flatten()
        parts.append(
            (
                cut_out(picture, uv)[seen].to(torch.uint8),
                uv.flatten(0, 1)[seen],
                batch["hand"].repeat_interleave(BRICKS, 0)[seen],
                truth(batch).bricks[..., 3:].flatten(0, 1)[seen],
            )
        )
    patches, places, hands, turns = (torch.cat(each) for each in zip(*parts, strict=True))

    def lesson(step: int) -> dict[str, Tensor]:
        rows = torch.from_numpy(random.integers(0, len(patches), TURN_BATCH))
        picture = patches[rows].float().mul_(1 / 255.0)
        each, colour = torch.randn(TURN_BATCH, 1, 1, 1), torch.randn(TURN_BATCH, 3, 1, 1)
        picture = picture * (1 + 0.12 * each + 0.05 * colour)
        picture = (picture + 0.03 * torch.randn(TURN_BATCH, 1, 1, 1)).clamp_(0, 1).sub_(0.5)
        uv, wanted = places[rows], turns[rows]
        if step % 2:  # The hand is symmetric.
            picture, uv = picture.flip(3), torch.stack([1 - uv[:, 0], uv[:, 1]], 1)
            wanted = wanted * torch.tensor([1.0, -1.0])
        return {"off": (net.eyes.turn(picture, uv, hands[rows]) - wanted).abs().mean()}

    teach(net.eyes.turn, steps, TURN_RATE, lesson, "turn")


def teach_will(
    net: Policy, every: dict[str, Tensor], data: Data | None, steps: int, seed: int
) -> None:
    """Train the waypoints, with the true scene and an error, and with the scene of the eyes.

    Args:
        net: the whole network; its eyes are trained.
        every: situations without images.
        data: those with images; None: only the others.
        steps: number of steps.
        seed: of the random draws.
    """
    random = np.random.default_rng((seed, 78))
    seen = None if data is None else _seen(net, data)

    def lesson(_: int) -> dict[str, Tensor]:
        rows = torch.from_numpy(random.integers(0, len(every["hand"]), WILL_BATCH))
        batch = {key: value[rows] for key, value in every.items()}
        moved, grip = will_loss(net, blurred(truth(batch)), batch)
        losses = {"moved": moved, "grip": GRIP_WEIGHT * grip}
        if seen is not None:
            rows = torch.from_numpy(random.integers(0, len(seen["hand"]), WILL_SEEN))
            batch = {key: value[rows] for key, value in seen.items()}
            moved, grip = will_loss(net, Scene(batch["bricks"], batch["box"]), batch)
            losses |= {"seen": 0.5 * moved, "seen_grip": 0.5 * GRIP_WEIGHT * grip}
        return losses

    teach(net.will, steps, WILL_RATE, lesson, "will", average=True)


def teach_going_on(net: Policy, every: dict[str, Tensor], steps: int, seed: int) -> None:
    """Train the waypoints after those that can no longer change; `Will.think` is trained.

    Training-time action conditioning: K. Black, A. Z. Ren, M. Equi, S. Levine, "Training-Time
    Action Conditioning for Efficient Real-Time Chunking", 2025, arXiv 2512.05964. Only the
    waypoints after the given ones are trained.
    """
    random = np.random.default_rng((seed, 80))

    def lesson(_: int) -> dict[str, Tensor]:
        rows = torch.from_numpy(random.integers(0, len(every["hand"]), WILL_BATCH))
        batch = {key: value[rows] for key, value in every.items()}
        moved, grip = will_loss(net, blurred(truth(batch)), batch, going_on=True)
        return {"moved": moved, "grip": GRIP_WEIGHT * grip}

    teach(net.will.go_on, steps, WILL_RATE, lesson, "going on", average=True)


def blurred(real: Scene) -> Scene:
    """A scene with errors like those of the eyes: larger far away, sometimes much larger."""
    count = len(real.box)
    size = torch.exp(0.6 * torch.randn(count, 1, 1))
    far = real.bricks[..., :3].norm(dim=-1, keepdim=True)
    error = torch.randn_like(real.bricks[..., :3]) * size * (0.012 + 0.04 * far)
    turn = real.bricks[..., 3:] + 0.08 * size * torch.randn_like(real.bricks[..., 3:])
    # The rotation of a brick cannot be seen from afar.
    lost = torch.rand(count, BRICKS, 1) < (0.6 * (far - 0.5)).clamp(0.02, 0.8)
    faint = turn * 0.6 * torch.rand(count, BRICKS, 1) + 0.1 * torch.randn_like(turn)
    turn = torch.where(lost, faint, turn)
    box_far = real.box.norm(dim=-1, keepdim=True)
    box = real.box + torch.randn_like(real.box) * size[:, 0] * (0.02 + 0.05 * box_far)
    return Scene(torch.cat([real.bricks[..., :3] + error, turn], -1), box)


@torch.no_grad()
def _seen(net: Policy, data: Data) -> dict[str, Tensor]:
    """Scenes by the eyes for all images, with the labels."""
    parts: list[dict[str, Tensor]] = []
    for rows in _in_turn(len(data), 200):
        batch = data.take(rows, (*NUMBERS, "front", "wrist"))
        scene = net.eyes(normal(batch["front"]), normal(batch["wrist"]), batch["hand"])
        kept = {key: batch[key] for key in NUMBERS}
        parts.append(kept | {"bricks": scene.bricks, "box": scene.box})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def _in_turn(count: int, size: int) -> Iterator[np.ndarray]:
    for begin in range(0, count, size):
        yield np.arange(begin, min(begin + size, count))


def will_loss(
    net: Policy, scene: Scene, batch: dict[str, Tensor], *, going_on: bool = False
) -> tuple[Tensor, Tensor]:
    """L1 of the waypoints, cross entropy of the gripper, under one order of each sample."""
    rows = torch.arange(len(scene.box))
    # The first order is the one that the situation was drawn for.
    pick = torch.randint(batch["orders"].shape[1], (len(rows),))
    pick = torch.where(torch.rand(len(rows)) < 0.5, 0, pick)
    orders = batch["orders"][rows, pick].long()
    way = batch["way_on" if going_on else "way"][rows, pick]
    given, weights = None, torch.tensor(STEP_WEIGHTS).expand(len(rows), -1)
    if going_on:
        given = batch["given"][rows, pick]
        given = torch.cat([given[..., :3] / UNIT_M, given[..., 3:]], -1)
        count = given[..., 5].sum(1).long()
        # The first free one has the weight of the first.
        after = torch.arange(weights.shape[1]) - count[:, None]
        weights = weights.gather(1, after.clamp(min=0)) * (after >= 0)
    hand = batch["hand"] + torch.randn_like(batch["hand"]) * torch.tensor(HAND_NOISE)
    kind = F.one_hot(orders[:, 0], len(KINDS)).float()
    target = F.one_hot(orders[:, 1], BRICKS).float()
    onto = F.one_hot(orders[:, 2].clamp(min=0), BRICKS).float() * (orders[:, 2:] >= 0)
    offset, opened = net.will(scene, hand, kind, target, onto, given)
    wanted = torch.cat([way[..., :3] / UNIT_M, way[..., 3:4]], -1)
    # In the first step the smallest errors count most: relative to its length.
    scale = 1.0 / (wanted[..., :3].norm(dim=-1, keepdim=True) + 0.15)
    moved = ((offset - wanted).abs() * weights[..., None] * scale).mean()
    wrong = F.binary_cross_entropy_with_logits(opened, way[..., 4], reduction="none")
    return moved, (wrong * weights).mean()
