"""Situations as numbers, and what the teacher would do in them: all of a sample but the pictures.

What to do is learned from many more situations than are worth drawing pictures of.
"""

from __future__ import annotations

import numpy as np
from expert import foretell
from states import Situation, draw, draw_order
from worker import Hand as Memory

from vla_zenoh.lab.tasks import COLOURS, DIRECTIONS, FAMILIES, Order

ORDERS = 4
"""Orders per situation: what the teacher would do under each."""
BOX_LOOK_M = 0.03
"""The box is looked for at half its height."""


def order_numbers(order: Order) -> list[int]:
    """Family (pushes apart by direction), target, onto as numbers; -1: none."""
    kinds = [*FAMILIES[:2], *DIRECTIONS]
    kind = order.direction if order.family == "push" else order.family
    onto = COLOURS.index(order.onto) if order.onto else -1
    return [kinds.index(kind), COLOURS.index(order.target), onto]


def label(situation: Situation, order: Order) -> np.ndarray:
    """(H, 5) what the teacher would do."""
    goal = situation.bricks[order.onto] if order.family == "stack" else situation.box
    way = foretell(
        order.family, situation.hand, situation.bricks[order.target], goal, order.direction
    )
    return np.array(way, np.float32)


def numbers(situation: Situation, random: np.random.Generator) -> dict[str, np.ndarray]:
    """One situation and what is taught about it.

    Args:
        situation: as it is.
        random: draws other orders, of which the teacher is asked too.

    Returns:
        hand (9,) see `model.Hand`; pose (4,) x, y, z, yaw; objects (5, 3) m; yaw (4,) of the
        bricks; orders (`ORDERS`, 3); way (`ORDERS`, H, 5).
    """
    hand = situation.hand
    points = np.array([situation.bricks[c][:3] for c in COLOURS] + [situation.box[:3]])
    points[len(COLOURS), 2] = BOX_LOOK_M
    place = np.array([hand.x_m, hand.y_m, hand.z_m])
    orders = [situation.order] + [draw_order(random) for _ in range(ORDERS - 1)]
    down = None if hand.down is None else np.array(hand.down)
    memory = Memory(place, hand.yaw_rad, hand.width_m, hand.swept_m, down)
    return {
        "hand": memory.numbers().astype(np.float32),
        "pose": np.array([*place, hand.yaw_rad], np.float32),
        "objects": points.astype(np.float32),
        "yaw": np.array([situation.bricks[c].yaw_rad for c in COLOURS], np.float32),
        "orders": np.array([order_numbers(o) for o in orders], np.int8),
        "way": np.stack([label(situation, o) for o in orders]),
    }


def blind(count: int, seed: tuple[int, ...]) -> dict[str, np.ndarray]:
    """So many situations without pictures, stacked."""
    random = np.random.default_rng(seed)
    samples = [numbers(draw(random), random) for _ in range(count)]
    return {key: np.stack([s[key] for s in samples]) for key in samples[0]}
