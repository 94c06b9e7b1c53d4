"""The statistics a model was trained with: from [-1, 1] back to metres and radians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import WorkerError

AXES = 7
"""x, y, z, roll, pitch, yaw, gripper."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Range:
    """Lower and upper bound that were mapped to -1 and 1.

    Args:
        low: (D,) in the units of the data.
        high: (D,) in the units of the data.
        mask: (D,) which numbers were scaled; the others are unchanged.
    """

    low: FloatArray
    high: FloatArray
    mask: NDArray[np.bool_]

    def expand(self, numbers: ArrayLike) -> FloatArray:
        """(..., D) numbers in [-1, 1] in the units of the data."""
        given = np.asarray(numbers, dtype=np.float64)
        return np.where(self.mask, 0.5 * (given + 1) * (self.high - self.low) + self.low, given)

    def shrink(self, numbers: ArrayLike) -> FloatArray:
        """(..., D) numbers in the units of the data to [-1, 1], cut off there."""
        given = np.asarray(numbers, dtype=np.float64)
        span = np.where(self.mask, self.high - self.low, 1.0)
        return np.clip(np.where(self.mask, 2 * (given - self.low) / span - 1, given), -1.0, 1.0)


def choose(statistics: Mapping[str, Any], key: str, where: str) -> str:
    """The key of the data set whose statistics are used; without one, the only one there is.

    Raises:
        WorkerError: none, or one that is not there; lists what is.
    """
    known = sorted(statistics)
    if not known:
        raise WorkerError(f"{where} holds no statistics, so actions have no units")
    if key in statistics:
        return key
    if not key and len(known) == 1:
        return known[0]
    said = f"unnorm_key {key!r} is not in {where}" if key else f"{where} has several data sets"
    raise WorkerError(f"{said}; say --set unnorm_key= one of: {', '.join(known)}")


def read_range(
    statistics: Mapping[str, Any], key: str, part: str = "action", size: int | None = AXES
) -> Range:
    """The range of a data set's actions (or of another part, like ``proprio``).

    Args:
        statistics: content of ``dataset_statistics.json``.
        key: of the data set, see `choose`.
        part: of the statistics.
        size: how many numbers there must be; None: as many as there are.

    Raises:
        WorkerError: the numbers are missing, not finite, of another count, or the wrong way round.
    """
    name = f"statistics of {key!r}, {part}"
    found = statistics[key].get(part) if isinstance(statistics[key], Mapping) else None
    if not isinstance(found, Mapping):
        raise WorkerError(f"{name}: there are none")
    low, high = (_numbers(found.get(bound), f"{name}, {bound}") for bound in ("q01", "q99"))
    mask = np.asarray(found.get("mask", [True] * len(low)), dtype=object)
    if not all(isinstance(entry, bool) for entry in mask):
        raise WorkerError(f"{name}, mask: wanted true and false")
    if not len(low) == len(high) == len(mask):
        raise WorkerError(
            f"{name}: {len(low)} numbers in q01, {len(high)} in q99, {len(mask)} in mask"
        )
    if size is not None and len(low) != size:
        raise WorkerError(
            f"{name}: {len(low)} numbers; this worker moves one arm with {size} "
            "(x, y, z, roll, pitch, yaw, gripper)"
        )
    if (high < low).any():
        raise WorkerError(f"{name}: q99 is below q01")
    still = np.flatnonzero((high == low) & mask.astype(bool))
    if len(still):
        raise WorkerError(
            f"{name}: q01 and q99 of number {still[0]} are both {low[still[0]]:g}: it never "
            "changed in the data, so it cannot be scaled. Set its mask to false, or give it a range"
        )
    return Range(low, high, mask.astype(bool))


def _numbers(given: Any, name: str) -> FloatArray:
    fits = isinstance(given, Sequence) and not isinstance(given, str) and len(given) > 0
    if not fits or not all(type(entry) in (int, float) for entry in given):
        raise WorkerError(f"{name}: wanted a list of numbers")
    numbers = np.asarray(given, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise WorkerError(f"{name}: a number that is not finite")
    return numbers
