# /// script
# requires-python = ">=3.11"
# dependencies = ["vla-zenoh", "torch>=2.4", "safetensors>=0.4"]
# ///
"""Trains the policy on what generate.py made. Goes on where it was interrupted.

    python train.py DATA OUT --minutes 45 --processes 2

``OUT/policy.safetensors`` is the mean of the weights of the last steps, ``OUT/resume.pt`` all that
is needed to go on. New shards in DATA are taken up while it runs. With several processes each makes
the gradient of its own batch with one thread; on a GPU one process is enough.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
import torch.nn.functional as F
from net import BRICKS, KINDS, STRIDE, UNIT_M, Policy, Scene, cut_out
from phrases import NO_TASK, Phrases, vocabulary
from rich.progress import Progress, TextColumn
from safetensors.torch import load_file, save_file
from torch import Tensor

KEYS = ("front", "wrist", "hand", "pose", "objects", "yaw", "front_px", "wrist_px", "orders", "way")
VALIDATION = 10
"""Every tenth shard is not trained with."""
LEAST_SHARE, WARM_STEPS = 0.015, 60
AVERAGE = 0.999
RELOAD_S = 60.0
SAY_S, SAVE_S = 60.0, 120.0
READER_STEPS, READER_BATCH, READER_RATE = 1500, 256, 3e-3
GEOMETRY_BATCH = 1024
GEOMETRY_KEYS = ("hand", "pose", "objects", "yaw", "orders", "way")
WILL_RATE = 2e-3
TURN_RATE, TURN_BATCH = 2e-3, 192
STEP_WEIGHTS = (1.6, 1.6, 1.4, 1.2, 1.0, 0.8, 0.6, 0.5)


class Data:
    """Shards in memory.

    Args:
        folder: of the shards.
        validation: those that are kept from training.
        part: this process's share is every `parts`-th shard from here on.
    """

    def __init__(self, folder: Path, *, validation: bool, part: int = 0, parts: int = 1) -> None:
        self._folder, self._validation, self._share = folder, validation, (part, parts)
        self._known: set[Path] = set()
        self._shards: dict[str, list[Tensor]] = {key: [] for key in KEYS}
        self._ends = np.zeros(0, np.int64)
        self.refresh()

    def refresh(self) -> None:
        """Take up shards that have come since."""
        part, parts = self._share
        for path in sorted(self._folder.glob("*.npz")):
            number = int(path.stem.rsplit("-", 1)[1])
            mine = self._validation or (number // VALIDATION + number) % parts == part
            if path in self._known or (number % VALIDATION == 0) != self._validation or not mine:
                continue
            self._known.add(path)
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


def truth(batch: dict[str, Tensor]) -> Scene:
    """The scene as it is, in the form of `net.Scene`."""
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


def spread(px: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Cells (n, K, 4) around each point and their weights; out of the picture: nowhere."""
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


def map_loss(log_maps: Tensor, px: Tensor, height: int, width: int) -> Tensor:
    """Cross entropy with the true place, shared among the four cells around it."""
    cells, weights = spread(px, height, width)
    return -(log_maps.gather(2, cells) * weights).sum(-1).mean()


def scene_loss(found: Scene, real: Scene) -> Tensor:
    """Distance, relative to how far it is from the hand: near ones have to be exact."""
    far = real.bricks[..., :2].norm(dim=-1, keepdim=True)
    weight = 1.0 / (far + 0.25)
    place = ((found.bricks[..., :3] - real.bricks[..., :3]).abs() * weight).mean()
    turn = ((found.bricks[..., 3:] - real.bricks[..., 3:]).abs() * weight).mean()
    box_weight = 1.0 / (real.box.norm(dim=-1, keepdim=True) + 0.5)
    box = ((found.box - real.box).abs() * box_weight).mean()
    return place + 0.12 * turn + 0.5 * box


def will_loss(
    net: Policy, scene: Scene, hand: Tensor, orders: Tensor, way: Tensor
) -> tuple[Tensor, Tensor]:
    """L1 of the waypoints, cross entropy of the gripper; orders (n, 3), way (n, H, 5)."""
    orders = orders.long()
    kind = F.one_hot(orders[:, 0], len(KINDS)).float()
    target = F.one_hot(orders[:, 1], BRICKS).float()
    onto = F.one_hot(orders[:, 2].clamp(min=0), BRICKS).float() * (orders[:, 2:] >= 0)
    offset, opened = net.will(scene, hand, kind, target, onto)
    wanted = torch.cat([way[..., :3] / UNIT_M, way[..., 3:4]], -1)
    weights = torch.tensor(STEP_WEIGHTS, device=way.device)[:, None]
    # In the first step the smallest mistakes count most: relative to how far it goes.
    scale = 1.0 / (wanted[..., :3].norm(dim=-1, keepdim=True) + 0.15)
    moved = ((offset - wanted).abs() * weights * scale).mean()
    grip = (F.binary_cross_entropy_with_logits(opened, way[..., 4], reduction="none")
            * weights[:, 0]).mean()  # fmt: skip
    return moved, grip


class Weather:
    """Other light, colours and noise for pictures. Noise is cut out of a stock: drawing is slow."""

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


def loss_of(net: Policy, batch: dict[str, Tensor], weather: Weather | None) -> dict[str, Tensor]:
    """All losses of one batch, under this weather."""
    front, wrist, hand = batch["front"], batch["wrist"], batch["hand"]
    if weather is not None:
        # What moves the hand a little between measuring and drawing moves the picture too.
        hand = hand + 0.01 * torch.randn_like(hand) * torch.tensor([1, 1, 1, 1, 1, 0, 1, 1, 0])
        pictures = weather(front), weather(wrist)
    else:
        pictures = tuple(p.permute(0, 3, 1, 2).float() / 255 - 0.5 for p in (front, wrist))
    scene, real = net.eyes(*pictures, hand), truth(batch)
    height, width = front.shape[1] // STRIDE, front.shape[2] // STRIDE
    losses = {"front": map_loss(scene.maps[0], batch["front_px"], height, width)}
    height, width = wrist.shape[1] // STRIDE, wrist.shape[2] // STRIDE
    losses["wrist"] = map_loss(scene.maps[1], batch["wrist_px"], height, width)
    losses["scene"] = scene_loss(scene, real)
    orders, way = batch["orders"], batch["way"]
    count = orders.shape[1]
    each = Scene(scene.bricks.repeat_interleave(count, 0), scene.box.repeat_interleave(count, 0))
    moved, grip = will_loss(
        net, each, hand.repeat_interleave(count, 0), orders.flatten(0, 1), way.flatten(0, 1)
    )
    losses |= {"moved": moved, "grip": grip}
    return losses


def taught_loss(net: Policy, batch: dict[str, Tensor]) -> Tensor:
    """What to do, where the scene is known but for a small error."""
    real = truth(batch)
    far = real.bricks[..., :3].norm(dim=-1, keepdim=True)
    error = torch.randn_like(real.bricks[..., :3]) * (0.008 + 0.04 * far)
    turn = real.bricks[..., 3:] + 0.1 * torch.randn_like(real.bricks[..., 3:])
    box = real.box + torch.randn_like(real.box) * (
        0.02 + 0.04 * real.box.norm(dim=-1, keepdim=True)
    )
    scene = Scene(torch.cat([real.bricks[..., :3] + error, turn], -1), box)
    pick = torch.randint(batch["orders"].shape[1], (len(box),))
    rows = torch.arange(len(box))
    moved, grip = will_loss(
        net, scene, batch["hand"], batch["orders"][rows, pick], batch["way"][rows, pick]
    )
    return moved + 0.4 * grip


WEIGHTS = {"front": 0.15, "wrist": 0.2, "scene": 1.0, "moved": 1.0, "grip": 0.4}


def train_reader(net: Policy, words: list[str], seed: int) -> float:
    """Teach the words; gives the share of sentences it reads wrongly at the end."""
    phrases, random = Phrases(words), np.random.default_rng((seed, 77))
    optimiser = torch.optim.AdamW(net.reader.parameters(), READER_RATE, weight_decay=1e-3)
    pool = [torch.from_numpy(each) for each in phrases.batch(random, 60_000)]
    wrong = 1.0
    for step in range(READER_STEPS):
        for group in optimiser.param_groups:
            group["lr"] = READER_RATE * max(0.02, 1 - step / READER_STEPS)
        rows = torch.from_numpy(random.integers(0, len(pool[0]), READER_BATCH))
        tokens, kind, target, onto = (each[rows] for each in pool)
        # A word that is not known may stand anywhere.
        read = net.reader(tokens)
        task = kind != NO_TASK
        loss = F.cross_entropy(read[0], kind)
        loss = loss + F.cross_entropy(read[1][task], target[task])
        stack = onto >= 0
        loss = loss + F.cross_entropy(read[2][stack], onto[stack])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        right = (read[0].argmax(1) == kind) & ((read[1].argmax(1) == target) | ~task)
        right &= (read[2].argmax(1) == onto) | ~stack
        wrong = 0.98 * wrong + 0.02 * (1 - right.float().mean().item())
    return wrong


def train_will(net: Policy, data: Data, seconds: float, seed: int) -> None:
    """Teach what to do where the scene is known, before anything is seen: it costs little."""
    random = np.random.default_rng((seed, 78))
    optimiser = torch.optim.AdamW(net.will.parameters(), WILL_RATE, weight_decay=1e-4)
    every = data.take(np.arange(len(data)), GEOMETRY_KEYS)
    begin = told = time.monotonic()
    total, count = 0.0, 0
    while (spent_s := time.monotonic() - begin) < seconds:
        for group in optimiser.param_groups:
            group["lr"] = WILL_RATE * max(0.05, 1 - spent_s / seconds)
        rows = torch.from_numpy(random.integers(0, len(data), GEOMETRY_BATCH))
        loss = taught_loss(net, {key: value[rows] for key, value in every.items()})
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.will.parameters(), 1.0)
        optimiser.step()
        total, count = total + loss.item(), count + 1
        if time.monotonic() - told > SAY_S / 2:
            print(f"will: {spent_s:.0f} s, {count} steps, taught {total / count:.4f}", flush=True)
            told, total, count = time.monotonic(), 0.0, 0


def train_turn(net: Policy, data: Data, seconds: float, seed: int) -> None:
    """Teach how bricks are turned, from patches cut out where they truly are."""
    random = np.random.default_rng((seed, 79))
    patches, places, hands, turns = [], [], [], []
    for begin in range(0, len(data), 500):
        rows = np.arange(begin, min(begin + 500, len(data)))
        batch = data.take(rows, (*GEOMETRY_KEYS, "wrist", "wrist_px"))
        picture = batch["wrist"].permute(0, 3, 1, 2).float()
        uv = batch["wrist_px"][:, :BRICKS, :2] + 0.012 * torch.randn(len(rows), BRICKS, 2)
        seen = ((uv > 0.02) & (uv < 0.98)).all(-1) & (batch["wrist_px"][:, :BRICKS, 2] > 0.02)
        seen = seen.flatten()
        patches.append(cut_out(picture, uv)[seen].to(torch.uint8))
        places.append(uv.flatten(0, 1)[seen])
        hands.append(batch["hand"].repeat_interleave(BRICKS, 0)[seen])
        turns.append(truth(batch).bricks[..., 3:].flatten(0, 1)[seen])
    patch, place, hand, turn = (torch.cat(each) for each in (patches, places, hands, turns))
    optimiser = torch.optim.AdamW(net.eyes.turn.parameters(), TURN_RATE, weight_decay=1e-3)
    begin_s = told = time.monotonic()
    total, count = 0.0, 0
    while (spent_s := time.monotonic() - begin_s) < seconds:
        for group in optimiser.param_groups:
            group["lr"] = TURN_RATE * max(0.02, 1 - spent_s / seconds)
        rows = torch.from_numpy(random.integers(0, len(patch), TURN_BATCH))
        picture = patch[rows].float().mul_(1 / 255.0)
        light = (
            1 + 0.12 * torch.randn(TURN_BATCH, 1, 1, 1) + 0.05 * torch.randn(TURN_BATCH, 3, 1, 1)
        )
        picture = (picture * light + 0.03 * torch.randn(TURN_BATCH, 1, 1, 1)).clamp_(0, 1).sub_(0.5)
        uv, wanted = place[rows], turn[rows]
        if count % 2:  # The hand is the same on both sides.
            picture, uv = picture.flip(3), torch.stack([1 - uv[:, 0], uv[:, 1]], 1)
            wanted = wanted * torch.tensor([1.0, -1.0])
        loss = (net.eyes.turn(picture, uv, hand[rows]) - wanted).abs().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        total, count = total + loss.item(), count + 1
        if time.monotonic() - told > SAY_S / 2:
            print(f"turn: {spent_s:.0f} s, {count} steps, {len(patch)} patches, "
                  f"{total / count:.4f}", flush=True)  # fmt: skip
            told, total, count = time.monotonic(), 0.0, 0


def learn(rank: int, args: argparse.Namespace, port: int) -> None:
    """One process of the training."""
    torch.set_num_threads(args.threads)
    if args.processes > 1:
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        dist.init_process_group("gloo", rank=rank, world_size=args.processes)
    torch.manual_seed(args.seed)
    words = vocabulary()
    net = Policy(len(words) + 2)
    resume = args.out / "resume.pt"
    seen_s, step = 0.0, 0
    seeing = [*net.eyes.parameters(), *net.will.parameters()]
    optimiser = torch.optim.AdamW(seeing, args.rate, weight_decay=1e-4)
    if resume.exists():
        state = torch.load(resume, weights_only=True)
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
        seen_s, step = state["seen_s"], state["step"]
        mean = state["mean"]
    else:
        if args.begin:
            net.load_state_dict(load_file(args.begin), strict=False)
        elif rank == 0:
            print(f"reader: {train_reader(net, words, args.seed):.4f} wrong", flush=True)
        if rank == 0:
            whole = Data(args.data, validation=False)
            train_turn(net, whole, args.turn_minutes * 60, args.seed)
            train_will(net, whole, args.will_minutes * 60, args.seed)
        if args.processes > 1:
            for value in net.state_dict().values():
                dist.broadcast(value, 0)
        mean = {name: value.clone() for name, value in net.state_dict().items()}
    torch.manual_seed(args.seed * 1000 + rank + step)
    random = np.random.default_rng((args.seed, rank, step))
    weather = Weather(args.seed)
    data = Data(args.data, validation=False, part=rank, parts=args.processes)
    check = Data(args.data, validation=True) if rank == 0 else None
    total_s = args.minutes * 60
    begin = told = saved = loaded = time.monotonic()
    sums: dict[str, float] = {}
    count = 0
    bar = Progress(*Progress.get_default_columns(), TextColumn("{task.fields[loss]}"))
    task = bar.add_task("training", total=total_s, loss="")
    if rank == 0 and args.bar:
        bar.start()
    while True:
        now = time.monotonic()
        spent_s = torch.tensor(seen_s + now - begin)
        if args.processes > 1:
            dist.broadcast(spent_s, 0)
        share = float(spent_s) / total_s
        if share >= 1:
            break
        if now - loaded > RELOAD_S:
            data.refresh()
            loaded = now
        rate = args.rate * min(1, (step + 1) / WARM_STEPS)
        rate *= LEAST_SHARE + (1 - LEAST_SHARE) * 0.5 * (1 + math.cos(math.pi * share))
        for group in optimiser.param_groups:
            group["lr"] = rate
        losses = loss_of(net, data.take(random.integers(0, len(data), args.batch)), weather)
        loss = sum(WEIGHTS[name] * value for name, value in losses.items())
        rows = random.integers(0, len(data), GEOMETRY_BATCH // args.processes)
        losses["taught"] = taught_loss(net, data.take(rows, GEOMETRY_KEYS))
        loss = loss + losses["taught"]
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if args.processes > 1:
            flat = torch.cat([p.grad.flatten() for p in seeing])
            dist.all_reduce(flat)
            flat /= args.processes
            at = 0
            for p in seeing:
                p.grad.copy_(flat[at : at + p.numel()].view_as(p))
                at += p.numel()
        torch.nn.utils.clip_grad_norm_(seeing, 1.0)
        optimiser.step()
        step, count = step + 1, count + 1
        with torch.no_grad():
            keep = min(AVERAGE, step / (step + 20))
            for name, value in net.state_dict().items():
                mean[name].mul_(keep).add_(value, alpha=1 - keep)
        for name, value in losses.items():
            sums[name] = sums.get(name, 0.0) + value.item()
        if rank:
            continue
        bar.update(task, completed=float(spent_s), loss=f"{loss.item():.3f}")
        if now - told > SAY_S:
            text = " ".join(f"{name} {value / count:.4f}" for name, value in sums.items())
            print(
                f"{float(spent_s):.0f} s, step {step}, {(now - told) / count * 1e3:.0f} ms a step, "
                f"{len(data) * args.processes} samples: {text}",
                flush=True,
            )
            told, sums, count = now, {}, 0
        if now - saved > SAVE_S:
            save(args.out, net, optimiser, mean, float(spent_s), step)
            print(validate(net, mean, check, args.seed), flush=True)
            saved = time.monotonic()
    if rank == 0:
        bar.stop()
        save(args.out, net, optimiser, mean, total_s, step)
        print(validate(net, mean, check, args.seed), flush=True)
    if args.processes > 1:
        dist.destroy_process_group()


def save(out: Path, net: Policy, optimiser, mean: dict[str, Tensor], seen_s: float, step: int):
    """Both files, each whole or not at all."""
    part = out / "resume.part"
    torch.save(
        {
            "net": net.state_dict(),
            "optimiser": optimiser.state_dict(),
            "mean": mean,
            "seen_s": seen_s,
            "step": step,
        },
        part,
    )
    part.rename(out / "resume.pt")
    part = out / "policy.part"
    save_file({name: value.contiguous() for name, value in mean.items()}, part)
    part.rename(out / "policy.safetensors")


@torch.no_grad()
def validate(net: Policy, mean: dict[str, Tensor], data: Data | None, seed: int) -> str:
    """How the mean of the weights does on shards it has not seen."""
    if data is None:
        return ""
    data.refresh()
    if not len(data):
        return "no validation shards yet"
    other = Policy(mean["reader.words.weight"].shape[0])
    other.load_state_dict(mean)
    other.eval()
    random = np.random.default_rng(seed)
    sums: dict[str, float] = {}
    errors = []
    for _ in range(6):
        batch = data.take(random.integers(0, len(data), 100))
        for name, value in loss_of(other, batch, None).items():
            sums[name] = sums.get(name, 0.0) + value.item() / 6
        pictures = (batch[c].permute(0, 3, 1, 2).float() / 255 - 0.5 for c in ("front", "wrist"))
        found, real = other.eyes(*pictures, batch["hand"]), truth(batch)
        off = (found.bricks[..., :2] - real.bricks[..., :2]).norm(dim=-1) * UNIT_M * 1e3
        errors.append(torch.stack([off, real.bricks[..., :2].norm(dim=-1) * UNIT_M * 1e3], -1))
    off, far = torch.cat(errors).flatten(0, 1).T
    near = " ".join(
        f"{a}-{b} mm: {off[(far >= a) & (far < b)].median():.1f}/"
        f"{off[(far >= a) & (far < b)].quantile(0.95):.1f}"
        for a, b in ((0, 15), (15, 60), (60, 120), (120, 500))
    )
    return "  check: " + " ".join(f"{n} {v:.4f}" for n, v in sums.items()) + " | off " + near


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--turn-minutes", type=float, default=5.0, help="before, patches alone")
    parser.add_argument("--will-minutes", type=float, default=3.0, help="before, no pictures")
    parser.add_argument("--rate", type=float, default=1.5e-3, help="greatest learning rate")
    parser.add_argument("--batch", type=int, default=48, help="pictures per process and step")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1, help="of each process")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--begin", type=Path, help="weights to begin with")
    parser.add_argument("--no-bar", dest="bar", action="store_false")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    port = 20_000 + os.getpid() % 20_000
    if args.processes > 1:
        mp.spawn(learn, (args, port), nprocs=args.processes)
    else:
        learn(0, args, port)


if __name__ == "__main__":
    main()
