"""Distributions and percentiles of measured values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, slots=True)
class Distribution:
    """How values are distributed; percentiles are interpolated linearly.

    Args:
        std: of a sample (divisor n - 1), 0 for a single value.
    """

    count: int
    mean: float
    std: float
    min: float
    p50: float
    p95: float
    p99: float
    max: float


def distribution(values: ArrayLike) -> Distribution | None:
    """The distribution of the finite ones among `values`, None when there are none."""
    found = np.asarray(values, np.float64)
    found = found[np.isfinite(found)]
    if not found.size:
        return None
    p50, p95, p99 = np.percentile(found, (50, 95, 99))
    return Distribution(
        int(found.size),
        float(found.mean()),
        float(found.std(ddof=1)) if found.size > 1 else 0.0,
        float(found.min()),
        float(p50),
        float(p95),
        float(p99),
        float(found.max()),
    )


def percentiles(values: ArrayLike) -> dict[str, float]:
    """p50, p95 and max, rounded to three digits; empty without values."""
    found = distribution(values)
    return {name: round(getattr(found, name), 3) for name in ("p50", "p95", "max") if found}
