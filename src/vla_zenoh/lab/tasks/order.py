"""Goal of a task, independent of its wording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from vla_zenoh.errors import RecordError

PUT, STACK, PUSH, STAY, LIFT = "put", "stack", "push", "stay", "lift"
FAMILIES = (PUT, STACK, PUSH)
COLOURS = ("red", "blue", "green", "yellow")
DIRECTIONS: Mapping[str, tuple[float, float]] = {
    "left": (0.0, 1.0),
    "right": (0.0, -1.0),
    "away": (1.0, 0.0),
    "closer": (-1.0, 0.0),
}
"""Unit vectors in the robot's base frame: left, right, away and closer as the robot sees it."""
BOX = "box"


def brick(colour: str) -> str:
    """Name of the brick of this colour among a scene's objects."""
    return f"{colour}_brick"


@dataclass(frozen=True, slots=True)
class Order:
    """Goal of a task.

    Args:
        family: ``put`` into the box, ``stack`` on another brick, ``push`` over the table; ``stay``
            for a nonsense prompt; ``lift`` the bar with both arms.
        target: colour of the brick to move; empty for ``stay`` and ``lift``.
        onto: colour of the brick below it; only for ``stack``.
        direction: one of `DIRECTIONS`; only for ``push``.

    Raises:
        RecordError: the parts do not match.
    """

    family: str
    target: str = ""
    onto: str = ""
    direction: str = ""

    def __post_init__(self) -> None:
        if self.family not in (*FAMILIES, STAY, LIFT):
            known = ", ".join((*FAMILIES, STAY, LIFT))
            raise RecordError(f"no family {self.family!r} of tasks; {known}")
        for name, value, allowed, wanted in (
            ("target", self.target, COLOURS, self.family in FAMILIES),
            ("onto", self.onto, COLOURS, self.family == STACK),
            ("direction", self.direction, tuple(DIRECTIONS), self.family == PUSH),
        ):
            if wanted and value not in allowed:
                raise RecordError(f"{name} is {value!r}, allowed: {', '.join(allowed)}")
            if not wanted and value:
                raise RecordError(f"a task {self.family!r} has no {name}, got {value!r}")
        if self.family == STACK and self.target == self.onto:
            raise RecordError(f"the {self.target} brick cannot stand on itself")


LIFT_PROMPT = "lift the bar"

TRAINING: Mapping[str, tuple[str, ...]] = {
    PUT: (
        "put the {x} brick in the box",
        "put the {x} brick into the box",
        "place the {x} brick in the box",
        "place the {x} block inside the gray box",
        "drop the {x} brick in the box",
        "move the {x} brick to the box",
        "move the {x} block into the container",
        "pick up the {x} brick and put it in the box",
        "pick up the {x} block and place it in the container",
        "take the {x} brick and put it into the gray box",
        "grab the {x} brick and drop it in the box",
        "the {x} brick goes in the box",
        "please put the {x} brick in the box",
        "could you place the {x} block into the box",
        "bring the {x} brick to the box",
        "box the {x} brick",
        "{x} brick in the box",
        "{x} brick into box please",
        "i want the {x} brick in the box",
        "fetch the {x} brick and put it in the container",
        "get the {x} brick into the box",
        "lay the {x} brick into the grey box",
    ),
    STACK: (
        "stack the {x} brick on the {y} brick",
        "stack the {x} brick on top of the {y} brick",
        "put the {x} brick on the {y} brick",
        "put the {x} brick on top of the {y} one",
        "place the {x} block on the {y} block",
        "place the {x} brick on top of the {y} brick",
        "pick up the {x} brick and stack it on the {y} brick",
        "pick up the {x} block and put it on the {y} one",
        "take the {x} brick and place it on top of the {y} brick",
        "set the {x} brick on the {y} brick",
        "move the {x} brick onto the {y} brick",
        "please stack the {x} block on the {y} block",
        "could you put the {x} brick onto the {y} brick",
        "the {x} brick goes on the {y} brick",
        "{x} brick on top of the {y} brick",
        "{x} on {y}",
        "on the {y} brick put the {x} brick",
        "i want the {x} brick on the {y} brick",
        "build a tower with the {x} brick on the {y} brick",
        "grab the {x} brick and set it on top of the {y} block",
    ),
    PUSH: (
        "push the {x} brick {d}",
        "push the {x} block {d}",
        "please push the {x} brick {d}",
        "slide the {x} brick {d}",
        "slide the {x} block {d} please",
        "shove the {x} brick {d}",
        "move the {x} brick {d}",
        "nudge the {x} brick {d}",
        "could you push the {x} brick {d}",
        "the {x} brick should go {d}",
        "give the {x} brick a push {d}",
        "{x} brick {d}",
        "i want the {x} brick pushed {d}",
    ),
}
HELD_OUT: Mapping[str, tuple[str, ...]] = {
    PUT: (
        "put the {x} block in the container",
        "take the {x} block and drop it into the box",
        "could you please put the {x} brick into the gray box",
        "grab the {x} block and place it inside the box",
        "i want you to move the {x} brick into the box",
        "get the {x} one and put it in the box",
        "the {x} block goes into the container",
    ),
    STACK: (
        "place the {x} one on top of the {y} one",
        "take the {x} block and stack it on the {y} brick",
        "could you stack the {x} brick on top of the {y} block please",
        "grab the {x} block and put it onto the {y} brick",
        "i want you to set the {x} brick on the {y} one",
        "on top of the {y} brick place the {x} one",
    ),
    PUSH: (
        "could you slide the {x} brick {d} please",
        "please shove the {x} block {d}",
        "i want you to push the {x} brick {d}",
        "nudge the {x} block {d} please",
        "push the {x} one {d}",
    ),
}
DIRECTION_PHRASES: Mapping[str, tuple[str, ...]] = {
    "left": ("to the left", "left", "leftwards", "to your left"),
    "right": ("to the right", "right", "rightwards", "to your right"),
    "away": ("away", "away from you", "forward", "further away"),
    "closer": ("closer", "closer to you", "towards you", "back towards you"),
}
NONSENSE = (
    "the weather is nice today",
    "what time is it",
    "brick brick brick",
    "sing a song about the sea",
    "lorem ipsum dolor sit amet",
    "asdf qwer zxcv",
    "put the purple elephant in the fridge",
    "do not put the red brick in the box",
    "tell me a joke",
    "red blue green yellow",
    "open the window",
    "stack",
    "hello robot",
    "put the brick in the box",
)
"""Prompts without a task: the arm has to stay."""


def phrase(order: Order, choice: int, *, held_out: bool = False) -> str:
    """A prompt for `order`.

    Args:
        choice: any number; selects the wording.
        held_out: use a wording that no model may be trained with.
    """
    if order.family == STAY:
        return NONSENSE[choice % len(NONSENSE)]
    wordings: Sequence[str] = (HELD_OUT if held_out else TRAINING)[order.family]
    which, rest = choice % len(wordings), choice // len(wordings)
    ways = DIRECTION_PHRASES.get(order.direction, ("",))
    return wordings[which].format(x=order.target, y=order.onto, d=ways[rest % len(ways)])


def parse_prompt(prompt: str) -> Order | None:
    """The goal of `prompt`, for judging; None: no known wording.

    Case, punctuation and spaces do not matter.
    """
    return Order(LIFT) if _plain(prompt) == LIFT_PROMPT else _orders().get(_plain(prompt))


def is_nonsense(prompt: str) -> bool:
    """The prompt is one of `NONSENSE`."""
    return _plain(prompt) in {_plain(text) for text in NONSENSE}


@cache
def _orders() -> dict[str, Order]:
    out: dict[str, Order] = {}
    for wordings in (TRAINING, HELD_OUT):
        for x in COLOURS:
            for wording in wordings[PUT]:
                out[_plain(wording.format(x=x))] = Order(PUT, x)
            for wording in wordings[STACK]:
                for y in COLOURS:
                    if y != x:
                        out[_plain(wording.format(x=x, y=y))] = Order(STACK, x, onto=y)
            for wording in wordings[PUSH]:
                for direction, ways in DIRECTION_PHRASES.items():
                    for way in ways:
                        text = _plain(wording.format(x=x, d=way))
                        out[text] = Order(PUSH, x, direction=direction)
    return out


def _plain(text: str) -> str:
    return " ".join(re.findall(r"[a-z]+", text.lower()))
