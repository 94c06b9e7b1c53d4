"""Statistics of columns, as LeRobot and OpenVLA keep them."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STRIDE = 4
"""Only every fourth row and column of an image counts."""


def of_numbers(rows: ArrayLike) -> dict[str, list[Any]]:
    """min, max, mean, std, count and quantiles of (n,) or (n, D), each of length D."""
    table = np.asarray(rows, np.float64)
    table = table.reshape(len(table), -1)
    out = {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        **{name: np.quantile(table, share, axis=0) for name, share in QUANTILES.items()},
    }
    return {name: value.tolist() for name, value in out.items()} | {"count": [len(table)]}


class Histogram:
    """Histogram of images, whose statistics LeRobot keeps for each channel.

    Args:
        step: value of one level; LeRobot's colours are in [0, 1].
        channels: of an image.
        levels: number of levels.
    """

    def __init__(self, step: float = 1 / 255, channels: int = 3, levels: int = 256) -> None:
        self.levels = np.zeros((channels, levels), np.int64)
        self.count, self._step = 0, step

    def add(self, image: NDArray[Any]) -> None:
        """Count the levels of an image, (H, W, channels) or (H, W)."""
        seen = image[::STRIDE, ::STRIDE].reshape(-1, len(self.levels))
        for levels, values in zip(self.levels, seen.T, strict=True):
            levels += np.bincount(values, minlength=len(levels))
        self.count += 1

    def join(self, other: Histogram) -> None:
        """Add the counts of another histogram."""
        self.levels += other.levels
        self.count += other.count

    def statistics(self) -> dict[str, list[Any]]:
        """As `of_numbers`, each of shape (channels, 1, 1); count is the number of images."""
        values = np.arange(self.levels.shape[1]) * self._step
        channels: dict[str, list[float]] = {}
        for levels in self.levels:
            seen = np.flatnonzero(levels)
            mean = float(levels @ values / levels.sum())
            below = np.cumsum(levels) / levels.sum()
            found = {
                "min": values[seen[0]],
                "max": values[seen[-1]],
                "mean": mean,
                "std": np.sqrt(levels @ (values - mean) ** 2 / levels.sum()),
                **{name: values[np.searchsorted(below, q)] for name, q in QUANTILES.items()},
            }
            for name, value in found.items():
                channels.setdefault(name, []).append(float(value))
        return {name: [[[v]] for v in found] for name, found in channels.items()} | {
            "count": [self.count]
        }


def joined(histograms: Iterable[Histogram]) -> dict[str, list[Any]]:
    """Statistics of all `histograms` together; there is at least one."""
    first, *others = (copy.deepcopy(each) for each in histograms)
    for other in others:
        first.join(other)
    return first.statistics()
