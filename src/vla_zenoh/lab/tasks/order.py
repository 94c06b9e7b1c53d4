"""Goal of a task, independent of its wording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
