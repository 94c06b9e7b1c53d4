"""A bound of the joints of an arm, of which some turn and others slide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.types.arrays import FloatArray


class JointBound(NamedTuple):
    """One bound for every joint of an arm, whether it turns or slides.

    A slide moves the TCP as far as itself. So it has the metres of a pose where a pose has a bound
    of the same kind, else 0.3 m for each rad: so far a joint moves what is 0.3 m from its axis.

    Args:
        turns: of a joint that turns: rad, rad/s.
        slides: of one that slides: m, m/s.
    """

    turns: float
    slides: float

    def of(self, slides: NDArray[np.bool_]) -> FloatArray:
        """(n,) of joints, those that slide being true in `slides`."""
        return np.where(slides, self.slides, self.turns)


STANDING = JointBound(0.02, 0.005)
"""rad/s, m/s: an arm whose joints are all slower stands."""
