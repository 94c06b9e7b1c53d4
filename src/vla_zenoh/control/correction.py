"""A correction that comes in smoothly: what a late command changes is not done in one step.

Between two commands the robot's side foretells the motion. Where the next command says something
else (it was held up, one was lost), or this side itself was late, the difference ``d`` stays in the
reference at first, so that neither position nor velocity steps, and then dies away like a
critically damped spring::

    d'' + 2 w d' + w^2 d = 0
    d(t) = (d0 + (d0' + w d0) t) exp(-w t)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vla_zenoh.types import FloatArray

STIFFNESS_1_S = 15.0
"""w: 20 mm then need at most 4.5 m/s^2 and are gone in a third of a second."""
NOTHING = 1e-9


class Difference(NamedTuple):
    """What is still to be corrected, (n,) each: value, its rate and that one's rate."""

    value: FloatArray
    rate: FloatArray
    change: FloatArray


class Correction:
    """See the module.

    Args:
        size: n.
        dt_s: of a tick.
    """

    def __init__(self, size: int, dt_s: float) -> None:
        self._size, self._dt_s = size, dt_s
        self.clear()

    def clear(self) -> None:
        """Nothing is to be corrected."""
        self.now: Difference | None = None

    def begin(self, value: FloatArray, rate: FloatArray) -> None:
        """This, (n,) each, is what the reference is away from the motion that is followed."""
        w = STIFFNESS_1_S
        self.now = Difference(value, rate, -2 * w * rate - w * w * value)

    def tick(self) -> None:
        """Let it die away for one tick."""
        if self.now is None:
            return
        w, t = STIFFNESS_1_S, self._dt_s
        fade, slope = math.exp(-w * t), self.now.rate + w * self.now.value
        value = (self.now.value + slope * t) * fade
        rate = slope * fade - w * value
        if float(np.abs(value).max()) < NOTHING and float(np.abs(rate).max()) < NOTHING:
            self.now = None
            return
        self.now = Difference(value, rate, -2 * w * rate - w * w * value)
