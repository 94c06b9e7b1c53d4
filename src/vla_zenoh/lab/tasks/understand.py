"""What a prompt asks for, found among all wordings there are: for judging, not for acting."""

from __future__ import annotations

import re
from functools import cache

from vla_zenoh.lab.tasks.order import COLOURS, PUSH, PUT, STACK, Order
from vla_zenoh.lab.tasks.words import HELD_OUT, NONSENSE, TRAINING, WAYS


def understand(prompt: str) -> Order | None:
    """The order that `prompt` is a wording of; None: of none that is known here.

    Case, punctuation and spaces do not matter.
    """
    return _orders().get(_plain(prompt))


def makes_no_sense(prompt: str) -> bool:
    """It is one of those that ask for nothing."""
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
                for direction, ways in WAYS.items():
                    for way in ways:
                        text = _plain(wording.format(x=x, d=way))
                        out[text] = Order(PUSH, x, direction=direction)
    return out


def _plain(text: str) -> str:
    return " ".join(re.findall(r"[a-z]+", text.lower()))
