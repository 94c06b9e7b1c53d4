"""Every wording is understood as what it was said for, and nothing else is."""

from __future__ import annotations

import pytest

from vla_zenoh.lab.tasks.order import (
    COLOURS,
    DIRECTIONS,
    NONSENSE,
    PUSH,
    PUT,
    STACK,
    Order,
    is_nonsense,
    parse_prompt,
    phrase,
)

ORDERS = [
    *(Order(PUT, x) for x in COLOURS),
    *(Order(STACK, x, onto=y) for x in COLOURS for y in COLOURS if x != y),
    *(Order(PUSH, x, direction=way) for x in COLOURS for way in DIRECTIONS),
]


@pytest.mark.parametrize("held_out", [False, True])
@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_every_wording_of_an_order_is_understood(order: Order, held_out: bool) -> None:
    for choice in range(200):
        prompt = phrase(order, choice, held_out=held_out)
        assert parse_prompt(prompt) == order, prompt
        assert parse_prompt(f"  {prompt.capitalize()}!") == order


@pytest.mark.parametrize("prompt", [*NONSENSE, "", "HARD: go up", "put the red brick"])
def test_what_asks_for_nothing_is_no_order(prompt: str) -> None:
    assert parse_prompt(prompt) is None


def test_nonsense_is_known_as_such() -> None:
    assert all(is_nonsense(prompt.upper()) for prompt in NONSENSE)
    assert not is_nonsense("put the red brick in the box")
