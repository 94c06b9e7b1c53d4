"""Situations as numbers, with the teacher's waypoints: all of a sample but the images.

Waypoints are learned from many more situations than are worth rendering.
"""

from __future__ import annotations

import math

import numpy as np
from expert import HORIZON, STEP_M, STEP_RAD, Row, foretell, wish
from states import Situation, draw, draw_order
from worker import Hand as Memory

from vla_zenoh.lab.tasks.order import COLOURS, DIRECTIONS, FAMILIES, Order

ORDERS = 4
"""Orders per situation, each with the teacher's waypoints."""
BOX_LOOK_M = 0.03
"""The box is looked for at half its height."""
MOST_COMMITTED = 6
LEAD_M, LEAD_RAD = 4 * STEP_M, 2 * STEP_RAD
"""How far the goal may be ahead of the hand."""
SURPRISE = 0.1
"""Share of committed waypoints that belong to another order, or have the gripper inverted."""


def order_numbers(order: Order) -> list[int]:
    """Family (pushes separated by direction), target, onto as numbers; -1: none."""
    kinds = [*FAMILIES[:2], *DIRECTIONS]
    kind = order.direction if order.family == "push" else order.family
    onto = COLOURS.index(order.onto) if order.onto else -1
    return [kinds.index(kind), COLOURS.index(order.target), onto]


def label(situation: Situation, order: Order, committed: tuple[Row, ...] = ()) -> np.ndarray:
    """(H, 5) the teacher's waypoints after those that can no longer change."""
    goal = situation.bricks[order.onto] if order.family == "stack" else situation.box
    target = situation.bricks[order.target]
    way = foretell(order.family, situation.hand, target, goal, order.direction, committed)
    return np.array(way, np.float32)


def draw_committed(
    random: np.random.Generator, situation: Situation, order: Order
) -> tuple[Row, ...]:
    """1 to `MOST_COMMITTED` waypoints that a chunk before this one may have left.

    Its perception was slightly off, and the goal is ahead of the hand.
    """
    if random.uniform() < SURPRISE:
        order = draw_order(random)
    hand, size = situation.hand, float(random.choice([0.001, 0.004, 0.012]))
    target, goal = (
        p._replace(
            x_m=p.x_m + size * float(random.normal()),
            y_m=p.y_m + size * float(random.normal()),
            z_m=p.z_m + 0.2 * size * float(random.normal()),
        )
        for p in (
            situation.bricks[order.target],
            situation.bricks[order.onto] if order.family == "stack" else situation.box,
        )
    )
    wished = wish(order.family, hand, target, goal, order.direction)
    x, y, z = wished.x_m - hand.x_m, wished.y_m - hand.y_m, wished.z_m - hand.z_m
    far_m = LEAD_M * random.uniform() ** 2
    share = min(1.0, far_m / max(math.hypot(x, y, z), 1e-9))
    off = random.normal(size=3) * 0.003
    turn = float(np.clip(wished.turn_rad, -LEAD_RAD, LEAD_RAD) * random.uniform())
    lead = (share * x + off[0], share * y + off[1], share * z + off[2], turn, float(wished.opened))
    way = foretell(order.family, hand, target, goal, order.direction, (lead,))
    count = int(random.integers(1, MOST_COMMITTED + 1))
    inverted = random.uniform() < SURPRISE
    return tuple((*row[:4], float((row[4] > 0.5) != inverted)) for row in way[1 : count + 1])


def numbers(
    situation: Situation, random: np.random.Generator, *, going_on: bool = False
) -> dict[str, np.ndarray]:
    """One situation and its labels.

    Args:
        situation: the true one.
        random: draws other orders, for which the teacher is asked too.
        going_on: with committed waypoints for each order.

    Returns:
        hand (9,) see `model.Hand`; pose (4,) x, y, z, yaw; objects (5, 3) m; yaw (4,) of the
        bricks; orders (`ORDERS`, 3); way (`ORDERS`, H, 5). With `going_on`: given (`ORDERS`, H, 6)
        as in `model.Brick.think`, way_on (`ORDERS`, H, 5) the teacher's waypoints after it.
    """
    hand = situation.hand
    points = np.array([situation.bricks[c][:3] for c in COLOURS] + [situation.box[:3]])
    points[len(COLOURS), 2] = BOX_LOOK_M
    place = np.array([hand.x_m, hand.y_m, hand.z_m])
    orders = [situation.order] + [draw_order(random) for _ in range(ORDERS - 1)]
    down = None if hand.down is None else np.array(hand.down)
    memory = Memory(place, hand.yaw_rad, hand.width_m, hand.swept_m, down)
    found = {
        "hand": memory.numbers().astype(np.float32),
        "pose": np.array([*place, hand.yaw_rad], np.float32),
        "objects": points.astype(np.float32),
        "yaw": np.array([situation.bricks[c].yaw_rad for c in COLOURS], np.float32),
        "orders": np.array([order_numbers(o) for o in orders], np.int8),
        "way": np.stack([label(situation, o) for o in orders]),
    }
    return found | _going_on(situation, orders, random) if going_on else found


def _going_on(
    situation: Situation, orders: list[Order], random: np.random.Generator
) -> dict[str, np.ndarray]:
    given = np.zeros((len(orders), HORIZON, 6), np.float32)
    ways = []
    for row, order in zip(given, orders, strict=True):
        committed = draw_committed(random, situation, order)
        row[: len(committed), :5], row[: len(committed), 5] = committed, 1.0
        ways.append(label(situation, order, committed))
    return {"given": given, "way_on": np.stack(ways)}


def blind(count: int, seed: tuple[int, ...]) -> dict[str, np.ndarray]:
    """`count` situations without images, stacked."""
    random = np.random.default_rng(seed)
    samples = [numbers(draw(random), random, going_on=True) for _ in range(count)]
    return {key: np.stack([s[key] for s in samples]) for key in samples[0]}
