"""Draws the task of an episode to fit the layout of the objects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.tasks.order import (
    BOX,
    COLOURS,
    DIRECTIONS,
    FAMILIES,
    PUSH,
    PUT,
    STACK,
    STAY,
    Order,
    brick,
    phrase,
)
from vla_zenoh.types import FloatArray, ObjectPoses

PUSH_BEHIND_M, PUSH_AHEAD_M = 0.06, 0.11
"""Free room behind and ahead of a brick that is to be pushed."""
CLEAR_M = 0.055
"""Clearance of other objects from the line of a push; the box adds half its size."""
BOX_HALF_M = 0.07
REACH_X_M, REACH_Y_M = (0.32, 0.70), (-0.36, 0.36)
"""Where a pushed brick may end."""
_STREAM = 0x7A5C


@dataclass(frozen=True, slots=True)
class TaskEpisode:
    """One task in one layout."""

    seed: int
    order: Order
    prompt: str


def draw_episode(
    seed: int,
    objects: ObjectPoses,
    *,
    family: str | None = None,
    target: str | None = None,
    held_out: bool = False,
) -> TaskEpisode:
    """Draw a feasible task; deterministic in its arguments.

    Args:
        family: one of `FAMILIES`; None: any.
        target: colour of the brick to move; None: any.
        held_out: use a wording that no model may be trained with.

    Raises:
        ResourceError: no such task in this layout; a push needs free room.
    """
    random = np.random.default_rng((_STREAM, seed))
    chosen = family or FAMILIES[int(random.integers(len(FAMILIES)))]
    orders = [o for o in _orders(chosen, objects) if target in (None, o.target)]
    if not orders:
        raise ResourceError(
            f"no task {chosen!r}{f' with the {target} brick' if target else ''} can be done in "
            f"layout {seed}; use another seed"
        )
    order = orders[int(random.integers(len(orders)))]
    prompt = phrase(order, int(random.integers(1 << 30)), held_out=held_out)
    return TaskEpisode(seed, order, prompt)


def draw_stay(seed: int) -> TaskEpisode:
    """A nonsense prompt: the arm has to stay."""
    order = Order(STAY)
    return TaskEpisode(seed, order, phrase(order, seed))


def _orders(family: str, objects: ObjectPoses) -> Iterator[Order]:
    if family == PUT:
        yield from (Order(PUT, x) for x in COLOURS)
    elif family == STACK:
        yield from (Order(STACK, x, onto=y) for x in COLOURS for y in COLOURS if x != y)
    elif family == PUSH:
        for colour in COLOURS:
            for direction in DIRECTIONS:
                if _room_is_free(objects, brick(colour), np.array(DIRECTIONS[direction])):
                    yield Order(PUSH, colour, direction=direction)
    else:
        raise ResourceError(f"no family {family!r} of tasks; {', '.join(FAMILIES)}")


def _room_is_free(objects: ObjectPoses, pushed: str, along: FloatArray) -> bool:
    places = {n: p[:2] for n, p in zip(objects.names, objects.position_m, strict=True)}
    start = places.pop(pushed)
    end = start + PUSH_AHEAD_M * along
    if not (REACH_X_M[0] <= end[0] <= REACH_X_M[1] and REACH_Y_M[0] <= end[1] <= REACH_Y_M[1]):
        return False
    for name, place in places.items():
        way = place - start
        nearest = np.clip(way @ along, -PUSH_BEHIND_M, PUSH_AHEAD_M) * along
        apart = np.abs(way - nearest)
        # The box is an axis-aligned square, everything else is small and round.
        if name == BOX:
            apart = np.maximum(apart - BOX_HALF_M, 0.0)
        if np.hypot(*apart) < CLEAR_M:
            return False
    return True
