"""The network: finds bricks and box in both images, reads the prompt, outputs waypoints.

    images   -> a map per object and camera -> where it is, relative to the hand   (`Eyes`)
    words    -> the task: its kind, brick, brick below                              (`Reader`)
    both     -> the next waypoints and when the gripper is open                     (`Will`)

The interfaces between the parts have a meaning, so each can be trained separately, every image
trains all bricks, and a new prompt is either one of the tasks or none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BRICKS = 4
KINDS = ("put", "stack", "left", "right", "away", "closer")
HORIZON = 8
HAND = 9
MEANING, READING = 48, 96
STRIDE = 4
FRONT_WIDTHS, WRIST_WIDTHS = (16, 32, 32, 32), (16, 32, 32, 32)
UNIT_M = 0.1
PATCH = 32
"""Pixels of a square around a brick, as wide as one directly before the camera."""
REST_M = 0.0096
BOX_RIM_M = 0.03
# Of the scene and of the wrist's mounting: camera position, its axes (columns), tan of half its
# vertical view. The wrist camera's in the frame of the hand: the base's, turned by the hand's yaw.
FRONT_POSITION = (1.13, -0.50, 0.82)
FRONT_AXES = (
    (0.580074, -0.561113, 0.590479),
    (0.814564, 0.399585, -0.420497),
    (0.0, 0.724902, 0.688852),
)
FRONT_VIEW = math.tan(math.radians(20.0))
WRIST_POSITION = (0.085, 0.0, 0.0734)
WRIST_AXES = ((0.0, 0.838444, 0.544988), (-1.0, 0.0, 0.0), (0.0, -0.544988, 0.838444))
WRIST_VIEW = math.tan(0.6)
ASPECT = 4 / 3


class Camera(nn.Module):
    """An image to one map per object.

    Args:
        objects: number of maps.
        widths: channels of the four layers.
    """

    def __init__(self, objects: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        a, b, c, d = widths
        self.layers = nn.Sequential(
            *self._layer(3, a, 5, 2, 1),
            *self._layer(a, b, 3, 2, 1),
            *self._layer(b, c, 3, 1, 1),
            *self._layer(c, d, 3, 1, 2),
        )
        self.maps = nn.Conv2d(d, objects, 1)
        self.nowhere = nn.Parameter(torch.zeros(objects))

    @staticmethod
    def _layer(inside: int, out: int, size: int, stride: int, spread: int) -> list[nn.Module]:
        padding = (size // 2) * spread
        return [
            nn.Conv2d(inside, out, size, stride, padding, dilation=spread, bias=False),
            nn.GroupNorm(8, out),
            nn.ReLU(),
        ]

    def forward(self, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability (B, K, cells + 1) of each object's cell, the last: nowhere; features."""
        features = self.layers(rgb)
        maps = self.maps(features).flatten(2)
        nowhere = self.nowhere[None, :, None].expand(len(maps), -1, 1)
        return F.log_softmax(torch.cat([maps, nowhere], 2), 2), features


class Seen(NamedTuple):
    """A camera's estimate of its objects: uv (B, K, 2) in [0, 1], there (B, K), features."""

    uv: Tensor
    there: Tensor
    features: Tensor


def gather(log_maps: Tensor, features: Tensor) -> Seen:
    """Mean place and mean features under each map."""
    height, width = features.shape[2:]
    weight = log_maps[:, :, :-1].exp()
    there = weight.sum(2)
    weight = weight / there[..., None].clamp(min=1e-6)
    rows, columns = torch.meshgrid(
        (torch.arange(height, device=features.device) + 0.5) / height,
        (torch.arange(width, device=features.device) + 0.5) / width,
        indexing="ij",
    )
    grid = torch.stack([columns.flatten(), rows.flatten()], 1)
    return Seen(weight @ grid, there, weight @ features.flatten(2).transpose(1, 2))


def onto_plane(uv: Tensor, axes: Tensor, position: Tensor, view: float, z_m: Tensor) -> Tensor:
    """(B, K, 2) where rays through uv meet the height z_m (B, K), in the frame of `position`."""
    across = (uv[..., 0] - 0.5) * (2 * view * ASPECT)
    up = (0.5 - uv[..., 1]) * (2 * view)
    local = torch.stack([across, up, -torch.ones_like(up)], -1)
    ray = local @ axes.T
    far = (z_m - position[2]) / ray[..., 2].clamp(max=-0.05)
    return position[:2] + far[..., None] * ray[..., :2]


class Turn(nn.Module):
    """Rotation of bricks, from the surrounding pixels in the wrist camera's image."""

    def __init__(self) -> None:
        super().__init__()
        self.look = nn.Sequential(
            nn.Conv2d(3, 16, 5, 2, 2, bias=False), nn.GroupNorm(4, 16), nn.ReLU(),
            nn.Conv2d(16, 32, 3, 2, 1, bias=False), nn.GroupNorm(4, 32), nn.ReLU(),
            nn.Conv2d(32, 32, 3, 1, 1, bias=False), nn.GroupNorm(4, 32), nn.ReLU(),
        )  # fmt: skip
        cells = (PATCH // 4) ** 2
        self.think = nn.Sequential(
            nn.Linear(32 * cells + 4, 96), nn.ReLU(), nn.Linear(96, 48), nn.ReLU(), nn.Linear(48, 2)
        )

    def forward(self, patches: Tensor, uv: Tensor, hand: Tensor) -> Tensor:
        """(n, 2) cosine and sine of four times the yaw relative to the hand.

        Args:
            patches: (n, 3, PATCH, PATCH) about zero.
            uv: (n, 2) place in the image where each was cut out, in [0, 1].
            hand: (n, 9).
        """
        place = torch.cat([uv - 0.5, hand[:, 2:4]], 1)
        return self.think(torch.cat([self.look(patches).flatten(1), place], 1))


def cut_out(picture: Tensor, uv: Tensor) -> Tensor:
    """(B * K, 3, PATCH, PATCH) patches around uv (B, K, 2) of images (B, 3, h, w)."""
    count, places = uv.shape[:2]
    height, width = picture.shape[2:]
    steps = torch.arange(PATCH, device=uv.device) - (PATCH - 1) / 2
    across, down = uv[..., 0] * 2 - 1, uv[..., 1] * 2 - 1
    x = across[..., None, None] + (2 * steps / width)[None, None, None, :]
    y = down[..., None, None] + (2 * steps / height)[None, None, :, None]
    grid = torch.stack(torch.broadcast_tensors(x, y), -1).reshape(count, places * PATCH, PATCH, 2)
    cut = F.grid_sample(picture, grid, align_corners=False)
    cut = cut.view(count, 3, places, PATCH, PATCH).transpose(1, 2)
    return cut.reshape(count * places, 3, PATCH, PATCH)


class Scene(NamedTuple):
    """Positions of objects, relative to the hand, in its frame, in `UNIT_M`.

    Args:
        bricks: (B, 4, 5) x, y, z, and cosine and sine of four times the yaw to the hand.
        box: (B, 2) x, y.
    """

    bricks: Tensor
    box: Tensor


class Places(NamedTuple):
    """Positions of objects, before their rotations are known.

    Args:
        bricks: (B, 4, 3) as in `Scene`.
        box: (B, 2) as in `Scene`.
        maps: front and wrist camera's log-probabilities, for training.
        uv: (B, 4, 2) of the bricks in the wrist camera's image.
        there: (B, 4) probability that they are in it.
    """

    bricks: Tensor
    box: Tensor
    maps: tuple[Tensor, Tensor]
    uv: Tensor
    there: Tensor


class Eyes(nn.Module):
    """Images and hand to a `Scene`."""

    def __init__(self) -> None:
        super().__init__()
        self.front = Camera(BRICKS + 2, FRONT_WIDTHS)  # the bricks, the box and the hand itself
        self.wrist = Camera(BRICKS + 1, WRIST_WIDTHS)
        inside = FRONT_WIDTHS[-1] + WRIST_WIDTHS[-1] + 6 + 6 + 2 + 2 + HAND
        self.turn = Turn()
        self.brick = nn.Sequential(
            nn.Linear(inside, 160), nn.ReLU(), nn.Linear(160, 96), nn.ReLU(), nn.Linear(96, 6)
        )
        self.box = nn.Sequential(
            nn.Linear(inside, 96), nn.ReLU(), nn.Linear(96, 64), nn.ReLU(), nn.Linear(64, 3)
        )
        for name, value in (
            ("front_axes", FRONT_AXES),
            ("front_position", FRONT_POSITION),
            ("wrist_axes", WRIST_AXES),
            ("wrist_position", WRIST_POSITION),
        ):
            self.register_buffer(name, torch.tensor(value), persistent=False)

    def forward(self, front: Tensor, wrist: Tensor, hand: Tensor) -> Scene:
        """Images (B, 3, h, w) about zero, hand (B, 9)."""
        places = self.find(front, wrist, hand)
        uv = places.uv.detach()
        around = hand.repeat_interleave(BRICKS, 0)
        turn = self.turn(cut_out(wrist, uv), uv.flatten(0, 1), around).view(-1, BRICKS, 2)
        # Outside the wrist camera's view the rotation of a brick is unknown.
        turn = turn * places.there[..., None].detach()
        return Scene(torch.cat([places.bricks, turn], 2), places.box)

    def find(self, front: Tensor, wrist: Tensor, hand: Tensor) -> Places:
        """Positions of objects; same arguments as `forward`."""
        front_maps, front_features = self.front(front)
        wrist_maps, wrist_features = self.wrist(wrist)
        seen, near = gather(front_maps, front_features), gather(wrist_maps, wrist_features)
        x, y, z = hand[:, 0] * 0.15 + 0.48, hand[:, 1] * 0.25, hand[:, 2] * 0.08 + 0.1
        sin, cos = hand[:, 4], hand[:, 5]

        heights = torch.full_like(seen.uv[:, :, 0], REST_M)
        heights[:, BRICKS] = BOX_RIM_M
        heights = torch.cat([heights[:, : BRICKS + 1], z[:, None]], 1)
        flat = onto_plane(seen.uv, self.front_axes, self.front_position, FRONT_VIEW, heights)
        flat = flat - torch.stack([x, y], 1)[:, None]
        turn = torch.stack([torch.stack([cos, -sin], 1), torch.stack([sin, cos], 1)], 1)
        flat = (flat @ turn).clamp(-0.6, 0.6) / UNIT_M  # into the hand's frame
        # Its estimate of the hand shows how far the front camera is from its nominal pose.
        astray = flat[:, BRICKS + 1 :]
        flat = flat[:, : BRICKS + 1]
        below = heights[:, : BRICKS + 1] - z[:, None]
        close = onto_plane(near.uv, self.wrist_axes, self.wrist_position, WRIST_VIEW, below)
        close = close.clamp(-0.6, 0.6) / UNIT_M
        level = onto_plane(
            near.uv, self.wrist_axes, self.wrist_position, WRIST_VIEW, torch.zeros_like(below)
        )
        level = level.clamp(-0.6, 0.6) / UNIT_M

        count = BRICKS + 1
        numbers = torch.cat(
            [
                seen.features[:, :count],
                near.features,
                seen.uv[:, :count],
                seen.there[:, :count, None],
                near.uv,
                near.there[..., None],
                flat - astray,
                close,
                level,
                seen.uv[:, count:].expand(-1, count, -1),
                astray.expand(-1, count, -1) * 0.3,
                hand[:, None].expand(-1, count, -1),
            ],
            2,
        )
        brick, box = self.brick(numbers[:, :BRICKS]), self.box(numbers[:, BRICKS])
        trust = torch.sigmoid(brick[..., 5:])
        xy = trust * close[:, :BRICKS] + (1 - trust) * (flat - astray)[:, :BRICKS] + brick[..., :2]
        trust = torch.sigmoid(box[:, 2:])
        box_xy = trust * close[:, BRICKS] + (1 - trust) * (flat - astray)[:, BRICKS] + box[:, :2]
        found = torch.cat([xy, brick[..., 2:3]], 2)
        maps = (front_maps, wrist_maps)
        return Places(found, box_xy, maps, near.uv[:, :BRICKS], near.there[:, :BRICKS])


class Reader(nn.Module):
    """Word pieces to a task.

    Args:
        pieces: size of the vocabulary, no piece and an unknown one included.
    """

    def __init__(self, pieces: int) -> None:
        super().__init__()
        self.register_buffer("meaning", torch.zeros(pieces, MEANING, dtype=torch.int8))
        self.drop = nn.Dropout(0.2)
        self.order = nn.GRU(MEANING, READING, batch_first=True, bidirectional=True)
        self.kind = nn.Linear(2 * READING, len(KINDS) + 1)
        self.target = nn.Linear(2 * READING, BRICKS)
        self.onto = nn.Linear(2 * READING, BRICKS)

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of kind (the last: no task), target and onto of tokens (B, T)."""
        return self.read(self.meaning[tokens].float() / 127.0, tokens)

    def read(self, meaning: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same, from the meaning of each piece (B, T, MEANING) in -1..1."""
        read, _ = self.order(self.drop(meaning))
        read = self.drop(read.masked_fill((tokens == 0)[..., None], -1.0).amax(1))
        return self.kind(read), self.target(read), self.onto(read)


# What matters about a number of the hand, or its distance to the brick, is on which side of a
# threshold it is: has the gripper shut on a brick, is it open, is the push complete. In the
# numbers' own scales: the threshold and its softness.
EDGES = (
    ("width", (0.0375 - 0.04) / 0.04, 0.002 / 0.04),
    ("width", (0.055 - 0.04) / 0.04, 0.006 / 0.04),
    ("width", (0.070 - 0.04) / 0.04, 0.002 / 0.04),
    ("width", (0.016 - 0.04) / 0.04, 0.005 / 0.04),
    ("height", (0.035 - 0.1) / 0.08, 0.004 / 0.08),
    ("height", (0.104 - 0.1) / 0.08, 0.006 / 0.08),
    ("swept", 0.105 / 0.05, 0.004 / 0.05),
    ("near", 0.007 / UNIT_M, 0.003 / UNIT_M),
    ("near", 0.0154 / UNIT_M, 0.004 / UNIT_M),
    ("near", 0.022 / UNIT_M, 0.004 / UNIT_M),
)
AHEAD = ((0.0, 0.0), (0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))
"""Direction of each of `KINDS` in the base frame, for those that have one."""


def asinh(value: Tensor) -> Tensor:
    """Logarithmic on both sides, so that millimetres count near zero."""
    size = value.abs()
    return value.sign() * torch.log(size + torch.sqrt(size * size + 1))


def turned(xy: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """xy (..., 2) turned by the angle of cos and sin (...)."""
    x, y = xy[..., 0], xy[..., 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def fine(value: Tensor) -> tuple[Tensor, Tensor]:
    """Features that distinguish centimetres and millimetres."""
    return asinh(value / 0.1), asinh(value / 0.02)


class Will(nn.Module):
    """A scene and a task to waypoints.

    Pushes are rotated into their direction, so that all four are one task; the absolute place makes
    no difference and is not an input.
    """

    def __init__(self) -> None:
        super().__init__()
        inside = 3 + (5 + 6) + (3 + 6) + 3 * 5 + len(EDGES) + HAND - 2 + 2
        self.think = nn.Sequential(
            nn.Linear(inside, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 256),
            nn.ReLU(), nn.Linear(256, HORIZON * 5),
        )  # fmt: skip
        inside += 256 + 6 * HORIZON + 5 + 6 + 3 + 6 + 1
        self.go_on = nn.Sequential(
            nn.Linear(inside, 176), nn.ReLU(), nn.Linear(176, 176), nn.ReLU(),
            nn.Linear(176, HORIZON * 5),
        )  # fmt: skip
        nn.init.zeros_(self.go_on[-1].weight)
        nn.init.zeros_(self.go_on[-1].bias)
        for name, value in (
            ("ahead", AHEAD),
            ("edges", [edge for _, edge, _ in EDGES]),
            ("widths", [width for _, _, width in EDGES]),
        ):
            self.register_buffer(name, torch.tensor(value), persistent=False)

    def forward(
        self,
        scene: Scene,
        hand: Tensor,
        kind: Tensor,
        target: Tensor,
        onto: Tensor,
        given: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Offsets (B, H, 4) in `UNIT_M` (rad) and logits (B, H) of an open gripper.

        Args:
            scene: relative to the hand.
            hand: (B, 9).
            kind: (B, 6) one-hot.
            target: (B, 4) one-hot.
            onto: (B, 4) one-hot, or all 0.
            given: (B, H, 6) as in `model.Brick.think`, but in `UNIT_M`: `go_on` changes the
                waypoints accordingly; None: nothing is given.
        """
        put, stack = kind[:, :1], kind[:, 1:2]
        push = 1 - put - stack
        sin, cos = hand[:, 4], hand[:, 5]
        # The frame: the hand's, but for a push the one whose x axis is its direction.
        ahead = kind @ self.ahead
        there_cos = push[:, 0] * ahead[:, 0] + (1 - push[:, 0]) * cos
        there_sin = push[:, 0] * ahead[:, 1] + (1 - push[:, 0]) * sin
        by_cos = there_cos * cos + there_sin * sin
        by_sin = there_cos * sin - there_sin * cos
        moved = torch.einsum("bk,bkd->bd", target, scene.bricks)
        below = torch.einsum("bk,bkd->bd", onto, scene.bricks)[:, :3] * stack
        moved = torch.cat([turned(moved[:, :2], by_cos, by_sin), moved[:, 2:]], 1)
        way = (scene.box - moved[:, :2]) * put
        up = (below[:, :2] - moved[:, :2]) * stack
        square = turned(way, cos, sin)  # the box lies along the base's axes
        turn = moved[:, 3:] * (1 - push)
        numbers = [put, stack, push, moved[:, :3], turn, *fine(moved[:, :3])]
        numbers += [below, *fine(below)]
        for each in (way, up, square):
            numbers += [each, *fine(each)[:1], each.norm(dim=1, keepdim=True)]
        near = moved[:, :2].norm(dim=1, keepdim=True)
        width, height, swept = hand[:, 6:7], hand[:, 2:3], hand[:, 7:8]
        values = {"width": width, "height": height, "swept": swept, "near": near}
        edges = torch.cat([values[name] for name, _, _ in EDGES], 1)
        numbers += [torch.tanh((edges - self.edges) / self.widths)]
        numbers += [hand[:, 2:], near, square.abs().amax(1, keepdim=True)]
        inside = torch.cat(numbers, 1)
        thought = self.think[:-1](inside)
        out = self.think[-1](thought).view(-1, HORIZON, 5)
        if given is not None:
            there = given[..., 5:]
            xy = turned(given[..., :2], there_cos[:, None], -there_sin[:, None])
            rows = torch.cat([xy, given[..., 2:4], 2 * given[..., 4:5] - 1], -1) * there
            # The last of them is where the motion continues.
            end = (there.sum(1, keepdim=True).long() - 1).clamp(min=0)
            last = rows.gather(1, end.expand(-1, 1, 5))[:, 0]
            left = moved[:, :3] - last[:, :3]
            numbers = [rows.flatten(1), there[..., 0], last, *fine(last[:, :3])]
            numbers += [left, *fine(left), asinh(left[:, :2].norm(dim=1, keepdim=True) / 0.1)]
            more = self.go_on(torch.cat([thought, inside, *numbers], 1))
            out = out + (more * there[:, 0]).view(-1, HORIZON, 5)
        xy = turned(out[..., :2], there_cos[:, None], there_sin[:, None])
        return torch.cat([xy, out[..., 2:4]], -1), out[..., 4]


class Policy(nn.Module):
    """The whole network, as it is exported."""

    def __init__(self, pieces: int) -> None:
        super().__init__()
        self.eyes, self.reader, self.will = Eyes(), Reader(pieces), Will()

    def forward(
        self, tokens: Tensor, front: Tensor, wrist: Tensor, hand: Tensor, given: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """See `model.Brick.think`; images (B, h, w, 3) uint8.

        Rows that are given may come back as anything: the worker keeps the given ones.

        Returns:
            offset (B, H, 4) m and rad, opened (B, H), understood (B,), order (B, 3) numbers of
            kind, brick and brick below, and its estimate of the scene: bricks (B, 4, 5) and box (B,
            2), relative to the hand in its frame, in m.
        """
        kind, target, onto = (torch.softmax(logits, 1) for logits in self.reader(tokens))
        task = kind[:, :-1].amax(1)
        is_stack = (kind[:, :-1].argmax(1) == 1).float()
        on_itself = is_stack * (target.argmax(1) == onto.argmax(1)).float()
        sure = target.amax(1) * (1 - is_stack + is_stack * onto.amax(1))
        understood = task * sure * (1 - on_itself)
        order = torch.stack([kind[:, :-1].argmax(1), target.argmax(1), onto.argmax(1)], 1)
        kind = F.one_hot(kind[:, :-1].argmax(1), len(KINDS)).float()
        target = F.one_hot(target.argmax(1), BRICKS).float()
        onto = F.one_hot(onto.argmax(1), BRICKS).float() * kind[:, 1:2]
        scene = self.eyes(normal(front), normal(wrist), hand)
        metres = torch.tensor([UNIT_M, UNIT_M, UNIT_M, 1.0])
        rows = torch.cat([given[..., :4] / metres, given[..., 4:]], -1)
        offset, opened = self.will(scene, hand, kind, target, onto, rows)
        believed = scene.bricks * torch.tensor([UNIT_M, UNIT_M, UNIT_M, 1.0, 1.0])
        box = scene.box * UNIT_M
        return offset * metres, torch.sigmoid(opened), understood, order, believed, box


def normal(rgb: Tensor) -> Tensor:
    """(B, h, w, 3) uint8 to (B, 3, h, w) about zero."""
    return rgb.permute(0, 3, 1, 2).float() / 255.0 - 0.5
