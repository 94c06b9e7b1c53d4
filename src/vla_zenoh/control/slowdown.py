"""How fast the arm may go where it comes near to a bound of its kinematics.

A barrier ``h`` (singular value or distance, minus its stop) that is inside of its zone ``z`` (slow
minus stop) and shrinks bounds the speed of the TCP to a share of the profile's::

    share = sqrt(h / z), at least SLOWEST

which is the speed that a constant deceleration can stop within what is left, when full speed can be
stopped within the zone. Away from a bound the arm goes at full speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.types import FloatArray

SLOWEST = 0.1
"""Share of its speed that is left to the arm close to a stop: it has to be able to work there."""
SHRINKING = 1e-6
"""A barrier that changes by less stays as it is."""


class Slowdown(NamedTuple):
    """Why the arm goes slower.

    Args:
        name: the bound, as in `vla_zenoh.control.limits.LimitHit`.
        share: of the speed limit that is left.
        value: singular value or distance there.
        limit: below which it slows down.
        where: the two links, or the link over the table; empty for the whole arm.
    """

    name: str
    share: float
    value: float
    limit: float
    where: str


def slowest(*reasons: Slowdown | None) -> Slowdown | None:
    """Of several reasons the one that leaves least speed."""
    return min((r for r in reasons if r is not None), key=lambda r: r.share, default=None)


def slowdown(
    before: FloatArray,
    after: FloatArray,
    stop: FloatArray,
    slow: FloatArray,
    names: Sequence[str],
    where: Callable[[int], str],
) -> Slowdown | None:
    """The bound that slows a step most, None for full speed.

    Args:
        before: (n,) barriers where the step begins.
        after: (n,) where it ends.
        stop: (n,) what a barrier is measured from.
        slow: (n,) where its zone begins.
        names: of the barriers.
        where: what of the arm barrier i is about.
    """
    zone = np.maximum(slow - stop, 1e-12)
    left = np.where(after < before - SHRINKING, np.clip(after / zone, 0.0, 1.0), 1.0)
    index = int(np.argmin(left))
    if left[index] >= 1.0:
        return None
    share = max(float(np.sqrt(left[index])), SLOWEST)
    value = float(after[index] + stop[index])
    return Slowdown(names[index], share, value, float(slow[index]), where(index))
