"""Draws situations that a policy may reach: poses of bricks, the task, the pose of the hand.

They lie around the teacher's paths, wider than it ever strays, with every stage of every task. That
needs no physics: a situation is a set of poses, drawn independently each time, so samples are
independent and include the errors of a learner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from expert import (
    BRICK_M,
    CARRY_M,
    HEIGHT_M,
    HOVER_M,
    LOW_M,
    LOWEST_M,
    OPEN_M,
    PUSH_LOW_M,
    PUSH_START_M,
    PUSH_WAY_M,
    RELEASE_M,
    RETREAT_M,
    Hand,
    Point,
    quarter,
)

from vla_zenoh.lab.tasks.order import COLOURS, DIRECTIONS, Order

REST_M = 0.0096
BRICK_X, BRICK_Y = (0.33, 0.68), (-0.33, 0.33)
BOX_X, BOX_Y = (0.41, 0.59), (-0.29, 0.29)
APART_M, BOX_APART_M = 0.078, 0.142
HAND_X, HAND_Y, HAND_Z = (0.31, 0.70), (-0.36, 0.36), (LOWEST_M, 0.23)
IN_BOX_Z = 0.0126
PARKED = -1.2


@dataclass(frozen=True, slots=True)
class Situation:
    """One moment.

    Args:
        bricks: by colour.
        box: pose of its centre.
        order: the task.
        hand: its state.
        tilt_rad: (2,) by which the tool deviates from straight down.
    """

    bricks: dict[str, Point]
    box: Point
    order: Order
    hand: Hand
    tilt_rad: tuple[float, float]


def draw(random: np.random.Generator) -> Situation:
    """One situation; a third of them for every family."""
    bricks, box = _layout(random)
    order = draw_order(random)
    if random.uniform() < 0.15:
        other = str(random.choice([c for c in COLOURS if c != order.target]))
        _do_something(random, bricks, box, other, order)
    stage = {"put": _grip, "stack": _grip, "push": _push}[order.family]
    hand = stage(random, bricks, box, order)
    if order.family != "push":
        hand = _with_past(random, hand)
    tilt = random.normal(size=2) * 0.006
    return Situation(bricks, box, order, hand, (float(tilt[0]), float(tilt[1])))


def draw_order(random: np.random.Generator) -> Order:
    """Any order, each family as often as the others."""
    family = str(random.choice(["put", "stack", "push"]))
    target, onto = (str(c) for c in random.permutation(COLOURS)[:2])
    direction = str(random.choice(list(DIRECTIONS)))
    return Order(
        family,
        target,
        onto if family == "stack" else "",
        direction if family == "push" else "",
    )


def _layout(random: np.random.Generator) -> tuple[dict[str, Point], Point]:
    while True:
        box = Point(*(random.uniform(*span) for span in (BOX_X, BOX_Y)), 0.0)
        places = random.uniform((BRICK_X[0], BRICK_Y[0]), (BRICK_X[1], BRICK_Y[1]), (4, 2))
        apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
        if apart[np.triu_indices(4, 1)].min() < APART_M:
            continue
        if np.hypot(places[:, 0] - box.x_m, places[:, 1] - box.y_m).min() < BOX_APART_M:
            continue
        yaws = random.uniform(-math.pi / 4, math.pi / 4, 4)
        bricks = {
            colour: Point(float(x), float(y), REST_M, float(yaw))
            for colour, (x, y), yaw in zip(COLOURS, places, yaws, strict=True)
        }
        return bricks, box


def _do_something(
    random: np.random.Generator, bricks: dict[str, Point], box: Point, colour: str, order: Order
) -> None:
    """Another task was done before this one: a brick is in the box, or on another."""
    if random.uniform() < 0.6:
        bricks[colour] = _in_box(random, box)
        return
    below = [c for c in COLOURS if c not in (colour, order.target, order.onto)]
    base = bricks[str(random.choice(below))]
    bricks[colour] = _on(random, base)


def _in_box(random: np.random.Generator, box: Point) -> Point:
    x, y = random.uniform(-0.048, 0.048, 2)
    return Point(box.x_m + x, box.y_m + y, IN_BOX_Z, random.uniform(-0.8, 0.8))


def _on(random: np.random.Generator, base: Point) -> Point:
    x, y = random.normal(size=2) * 0.004
    return Point(
        base.x_m + x, base.y_m + y, base.z_m + HEIGHT_M, base.yaw_rad + random.uniform(-0.8, 0.8)
    )


def _anywhere(random: np.random.Generator) -> tuple[float, float, float]:
    return (
        float(random.uniform(*HAND_X)),
        float(random.uniform(*HAND_Y)),
        float(random.uniform(0.07, HAND_Z[1])),
    )


def _home(random: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = random.normal(size=3) * (0.02, 0.02, 0.012) + (0.43, 0.0, 0.16)
    return float(x), float(y), float(z)


def _width(random: np.random.Generator, *, shut: bool = False) -> float:
    """Mostly the right opening, at times on the way to it."""
    if random.uniform() < 0.85:
        return 0.0 if shut else OPEN_M
    return float(random.uniform(0.0, OPEN_M))


def _spread(random: np.random.Generator) -> float:
    """A distance: often small, at times large."""
    return float(random.choice([0.003, 0.008, 0.02, 0.06], p=[0.3, 0.3, 0.25, 0.15]))


def _between(random: np.random.Generator, a: Point, b: Point) -> tuple[float, float]:
    share = random.uniform()
    x, y = random.normal(size=2) * 0.012
    return a.x_m + share * (b.x_m - a.x_m) + x, a.y_m + share * (b.y_m - a.y_m) + y


def _grip(random: np.random.Generator, bricks: dict[str, Point], box: Point, order: Order) -> Hand:
    target = bricks[order.target]
    goal = box if order.family == "put" else bricks[order.onto]
    stage = random.choice(
        ["start", "way", "near", "shutting", "lifting", "carrying", "over", "done"],
        p=[0.10, 0.16, 0.24, 0.10, 0.07, 0.10, 0.15, 0.08],
    )
    yaw = float(random.normal() * 0.3) if random.uniform() < 0.5 else 0.0
    if stage == "start":
        place = _home(random) if random.uniform() < 0.5 else _anywhere(random)
        return Hand(*place, yaw * 0.5, _width(random))
    if stage == "way":
        x, y = _between(random, Point(0.43, 0.0, 0.16), target)
        z = random.uniform(0.075, 0.17)
        return Hand(x, y, float(z), yaw, _width(random))
    aligned = quarter(target.yaw_rad - yaw) + yaw
    if stage == "near":
        spread = _spread(random)
        x, y = random.normal(size=2) * spread
        off = math.hypot(x, y)
        height = LOWEST_M + min(HOVER_M, off * 3.5) + random.normal() * 0.012
        height += float(random.uniform() < 0.4) * random.uniform(0.0, 0.07)
        turn = random.normal() * random.choice([0.08, 0.3])
        z = float(np.clip(height, *HAND_Z))
        width = _width(random)
        if z < 0.04 and abs(turn) > 0.3:
            turn *= 0.3
        return Hand(target.x_m + x, target.y_m + y, z, aligned + float(turn), width)
    turn = float(random.normal() * 0.06)
    if stage == "shutting":
        x, y = random.normal(size=2) * random.choice([0.004, 0.008])
        z = LOWEST_M + abs(random.normal()) * random.choice([0.003, 0.008])
        bricks[order.target] = target._replace(yaw_rad=aligned + turn)
        # Just before it has gripped, little shows that it has not.
        most = OPEN_M if random.uniform() < 0.6 else 0.045
        width = float(random.uniform(BRICK_M, most))
        return Hand(target.x_m + x, target.y_m + y, float(z), aligned + turn, width)
    if stage == "done":
        bricks[order.target] = placed = (
            _in_box(random, box) if order.family == "put" else _on(random, goal)
        )
        near = random.uniform() < 0.7
        x, y = (random.normal(size=2) * 0.006) if near else (0.0, 0.0)
        if order.family == "put":
            low = RELEASE_M - 0.004
            if near:
                place = (placed.x_m + x, placed.y_m + y, float(random.uniform(low, 0.22)))
            else:
                place = _anywhere(random)
        elif near:
            z = placed.z_m + 0.003 + abs(random.choice([0.002, 0.1]) * random.uniform())
            place = (placed.x_m + x, placed.y_m + y, float(z))
        else:
            place = _anywhere(random)
        close = order.family == "stack" and near and place[2] < placed.z_m + 0.02
        width = float(random.uniform(BRICK_M, OPEN_M)) if close else _width(random)
        if order.family == "put" and place[2] < 0.12:
            width = float(random.uniform(0.036, OPEN_M))
        return Hand(*place, yaw, width)
    # In the hand. Gripped off centre.
    hold_x = float(np.clip(random.normal() * 0.004, -0.011, 0.011))
    hold_y = float(np.clip(random.normal() * 0.0015, -0.004, 0.004))
    hang = 0.0042 + random.normal() * 0.0015
    if random.uniform() < 0.35:
        hang = random.uniform(0.0, 0.013)
    hang = float(np.clip(hang, 0.0, 0.013))
    width = BRICK_M + float(abs(random.normal())) * 0.0006
    if stage == "lifting":
        x, y = target.x_m, target.y_m
        just = random.uniform() < 0.4
        z = REST_M + hang + (abs(random.normal()) * 0.002 if just else random.uniform(0.0, 0.12))
    elif stage == "carrying":
        x, y = _between(random, target, goal)
        z = random.normal() * 0.015 + (CARRY_M if order.family == "put" else 0.11)
    else:
        spread = _spread(random)
        dx, dy = random.normal(size=2) * spread
        x, y = goal.x_m + dx, goal.y_m + dy
        if order.family == "put":
            z = random.uniform(RELEASE_M - 0.006, CARRY_M + 0.02)
        else:
            least = goal.z_m + HEIGHT_M + hang
            z = least + min(0.075, 3.0 * math.hypot(dx, dy)) + abs(random.normal()) * 0.012
    hand = Hand(float(x), float(y), float(np.clip(z, LOWEST_M, 0.23)), yaw, width)
    cos, sin = math.cos(yaw), math.sin(yaw)
    bricks[order.target] = Point(
        hand.x_m + cos * hold_x - sin * hold_y,
        hand.y_m + sin * hold_x + cos * hold_y,
        hand.z_m - hang,
        yaw + float(random.normal()) * 0.01,
    )
    if order.family == "put" and stage == "over" and random.uniform() < 0.2:
        # Just being released.
        return Hand(hand.x_m, hand.y_m, hand.z_m, yaw, float(random.uniform(BRICK_M, 0.045)))
    return hand


def _with_past(random: np.random.Generator, hand: Hand) -> Hand:
    """It has swept over the table before, as hands do unintentionally when they grip."""
    few = random.uniform() < 0.75
    swept = abs(random.normal()) * 0.006 if few else random.uniform(0.0, 0.15)
    x, y = random.normal(size=2) * 0.003
    down = (hand.x_m + float(x), hand.y_m + float(y)) if hand.z_m < LOW_M else None
    return replace(hand, swept_m=float(swept), down=down).swept()


def _push(random: np.random.Generator, bricks: dict[str, Point], box: Point, order: Order) -> Hand:
    del box
    target = bricks[order.target]
    u_x, u_y = DIRECTIONS[order.direction]
    stage = random.choice(
        ["start", "way", "near", "pushing", "beside", "done"],
        p=[0.12, 0.20, 0.30, 0.25, 0.03, 0.10],
    )
    yaw = float(random.normal() * 0.03) if random.uniform() < 0.85 else float(random.normal() * 0.3)
    start = Point(target.x_m - PUSH_START_M * u_x, target.y_m - PUSH_START_M * u_y, PUSH_LOW_M)
    width = _width(random, shut=True)
    if stage == "start":
        place = _home(random) if random.uniform() < 0.6 else _anywhere(random)
        return Hand(*place, yaw, float(random.choice([0.0, OPEN_M, random.uniform(0, OPEN_M)])))
    if stage == "way":
        x, y = _between(random, Point(0.43, 0.0, 0.16), start)
        return Hand(x, y, float(random.uniform(0.075, 0.17)), yaw, _width(random, shut=True))
    if stage == "near":
        spread = _spread(random)
        x, y = random.normal(size=2) * spread
        height = PUSH_LOW_M + min(HOVER_M, 3.5 * math.hypot(x, y)) + random.normal() * 0.012
        height += float(random.uniform() < 0.3) * random.uniform(0.0, 0.07)
        z = float(np.clip(height, LOWEST_M, 0.23))
        swept = abs(random.normal()) * 0.003 if z < LOW_M else 0.0
        hand = Hand(start.x_m + x, start.y_m + y, z, yaw, width if z > 0.07 else 0.0, swept)
        return hand.swept()
    if stage in ("pushing", "beside"):
        made = random.uniform(0.0, PUSH_WAY_M + 0.004)
        ahead = random.uniform(0.022, 0.030) if made > 0.03 else PUSH_START_M - made
        side = random.normal() * (0.005 if stage == "pushing" else 0.03)
        x = target.x_m - ahead * u_x + side * u_y
        y = target.y_m - ahead * u_y - side * u_x
        z = float(np.clip(PUSH_LOW_M + random.normal() * 0.002, LOWEST_M, 0.03))
        hand = Hand(x, y, z, yaw, 0.0, float(made), (x - made * u_x, y - made * u_y))
        if made > 0.03:
            bricks[order.target] = target._replace(yaw_rad=target.yaw_rad * 0.3)
        return hand
    made = PUSH_WAY_M + abs(random.normal()) * 0.006
    ahead = random.normal() * 0.004 + 0.027
    z = random.choice([PUSH_LOW_M + 0.003, random.uniform(0.02, RETREAT_M + 0.01)])
    x, y = target.x_m - ahead * u_x, target.y_m - ahead * u_y
    down = (x - made * u_x, y - made * u_y) if z < LOW_M else None
    return Hand(x, y, float(z), yaw, 0.0, float(made), down)
