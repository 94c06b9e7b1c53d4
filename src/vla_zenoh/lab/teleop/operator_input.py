"""What the person at the controls wants right now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

AXES = 6
Twist = tuple[float, float, float, float, float, float]
STILL: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
DEAD_ZONE = 0.08
"""A stick that is let go rests this near to its middle."""


class OperatorInput(NamedTuple):
    """One look at the controls.

    Args:
        twist: x, y, z and the rotation about them, each a share of the chosen speed in [-1, 1].
        opening: the gripper wider (1) or narrower (-1), likewise.
        toggles: how often so far the gripper was told to open or close; only changes count.
    """

    twist: Twist = STILL
    opening: float = 0.0
    toggles: int = 0


class Hand(Protocol):
    """Something with sticks."""

    def wish(self) -> OperatorInput:
        """What is wanted now.

        Raises:
            PeerError: the device is gone.
        """
        ...


def joined(one: OperatorInput, other: OperatorInput) -> OperatorInput:
    """Both at once, no axis beyond its end."""
    twist = [_clipped(a + b) for a, b in zip(one.twist, other.twist, strict=True)]
    opening = _clipped(one.opening + other.opening)
    return OperatorInput(as_twist(twist), opening, one.toggles + other.toggles)


def as_twist(values: Sequence[float]) -> Twist:
    """Six numbers in [-1, 1]; what is more is cut off."""
    x, y, z, a, b, c = (_clipped(value) for value in values)
    return x, y, z, a, b, c


def of_stick(value: float) -> float:
    """A stick's position without its dead zone: steady from 0 at the zone's edge to +-1."""
    size = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    if not size > 0:  # NaN too
        return 0.0
    return min(size, 1.0) * (1.0 if value > 0 else -1.0)


def _clipped(value: float) -> float:
    return min(max(value, -1.0), 1.0)
