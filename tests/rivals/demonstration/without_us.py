"""The same two orders by the maker's library alone: into the table, and a program that dies."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from trossen_rig import HOME, Controller, TrossenProcess, bring_home

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

FLOOR = "floor"
PRESSES_S, MOVE_S = 2.0, 2.0
PIECES, PIECE_S, KILLED_AFTER = 20, 0.2, 8
LISTENS_S = 3.0


def pressed_n(controller: Controller) -> float:
    """The largest force between arm and floor within `PRESSES_S`."""
    most_n, end_s = 0.0, time.monotonic() + PRESSES_S
    while time.monotonic() < end_s:
        contacts = controller.ask()["contacts"]
        most_n = max([most_n, *(one["force"] for one in contacts if one["geom2"] == FLOOR)])
        time.sleep(0.02)
    return most_n


def into_the_table(joints_rad: Sequence[float]) -> float:
    """Send the arm there; the largest force on the floor, N."""
    with Controller() as controller:
        bring_home()
        with TrossenProcess("client") as client:
            client.ask(to=[*joints_rad, HOME[-1]], **{"in": MOVE_S})
            return pressed_n(controller)


def killed_on_the_way(
    path_rad: Sequence[Sequence[float]], height_m: Callable[[Any], float]
) -> tuple[float, list[str]]:
    """A program streams a path and is killed on it: how far short the arm is, and its modes."""
    with Controller() as controller:
        bring_home()
        client = TrossenProcess("client")
        pieces = np.linspace(0, len(path_rad) - 1, PIECES + 1).round().astype(int)[1:]
        for number in pieces[:KILLED_AFTER]:
            client.ask(to=[*path_rad[number], HOME[-1]], **{"in": PIECE_S})
        client.kill()
        time.sleep(LISTENS_S)
        short_m = height_m(path_rad[-1]) - height_m(controller.joints_rad()[:6])
        return short_m, sorted(set(controller.ask()["modes"]))
