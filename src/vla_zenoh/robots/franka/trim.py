"""Compensates joint friction: a bounded correction that is added to the set-point.

A spring stops short of its goal by the friction divided by its stiffness. The integral part removes
that over time; alone it overshoots and creeps from side to side, which the proportional part
prevents.
"""

from __future__ import annotations

import numpy as np

from vla_zenoh.types import FloatArray

INTEGRAL_S, PROPORTION = 0.2, 1.5
MOST_M, MOST_RAD, MOST_JOINT_RAD = 0.008, 0.03, 0.008
"""Limits. Friction of an FR3 takes half of them at the stiffness of its profile."""


class Trim:
    """Correction of one motion's set-points, from `left`: set-point minus measured value.

    Args:
        columns: 6 for a pose (m, rad), 7 for joints (rad).
    """

    def __init__(self, columns: int) -> None:
        self._poses = columns == 6
        self._integral: FloatArray = np.zeros(columns)

    def update(self, left: FloatArray, elapsed_s: float) -> FloatArray:
        """The correction of the set-point, `elapsed_s` after the last one."""
        self._integral = self._bounded(self._integral + elapsed_s / INTEGRAL_S * left)
        return self._bounded(self._integral + PROPORTION * left)

    def emptied(self) -> Trim:
        """A correction that starts from zero."""
        return Trim(len(self._integral))

    def _bounded(self, trim: FloatArray) -> FloatArray:
        if not self._poses:
            return np.clip(trim, -MOST_JOINT_RAD, MOST_JOINT_RAD)
        return np.concatenate((_shortened(trim[:3], MOST_M), _shortened(trim[3:], MOST_RAD)))


def _shortened(vector: FloatArray, most: float) -> FloatArray:
    """`vector` (3,), shortened to a length of `most`."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))
