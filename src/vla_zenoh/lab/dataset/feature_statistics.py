"""Statistics of columns, as LeRobot and OpenVLA keep them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
LEVELS = 256
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


class Colours:
    """Histogram of the colours of images; statistics are in [0, 1] as LeRobot's."""

    def __init__(self) -> None:
        self.levels = np.zeros((3, LEVELS), np.int64)
        self.count = 0

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Count the colours of an image, (H, W, 3)."""
        for channel in range(3):
            seen = rgb[::STRIDE, ::STRIDE, channel].reshape(-1)
            self.levels[channel] += np.bincount(seen, minlength=LEVELS)
        self.count += 1

    def join(self, other: Colours) -> None:
        """Add the counts of another histogram."""
        self.levels += other.levels
        self.count += other.count

    def statistics(self) -> dict[str, list[Any]]:
        """As `of_numbers`, each of shape (3, 1, 1); count is the number of images."""
        values = np.arange(LEVELS) / (LEVELS - 1)
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
