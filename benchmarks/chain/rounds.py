"""Percentiles, and ratios of ways that were measured in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, slots=True)
class Interval:
    """Results of one way in one round.

    Args:
        way: name of the way.
        figures_ms: figure -> one value per request, in ms.
        cpu_ms: figure -> CPU time of one request in all processes that take part, in ms.
        standing_cpu: share of one core that our chain takes while its arm rests.
        lost: requests that were not answered.
    """

    way: str
    figures_ms: Mapping[str, Sequence[float]]
    cpu_ms: Mapping[str, float] = field(default_factory=dict)
    standing_cpu: float = 0.0
    lost: int = 0


@dataclass(frozen=True, slots=True)
class Summary:
    """One figure of one way over all rounds, in ms.

    Args:
        p50: of all requests.
        p95: of all requests.
        p99: of all requests.
        low: smallest median of a round.
        high: largest median of a round.
        cpu: CPU time of one request, median of the rounds, or None.
        ratio: median over the rounds of this median by the reference's in the same round, or None.
        requests: their number.
    """

    p50: float
    p95: float
    p99: float
    low: float
    high: float
    cpu: float | None
    ratio: float | None
    requests: int


def summarise(
    rounds: Sequence[Mapping[str, Interval]], way: str, figure: str, reference: tuple[str, str]
) -> Summary | None:
    """One figure of one way; None when it was never measured.

    Args:
        rounds: way -> its results, one map per round.
        way: name of the way.
        figure: which of its figures.
        reference: (way, figure) that the ratio is taken to. Both are from the same round, so that a
            slow moment of the machine affects both.
    """
    measured = [
        (slots[way], slots)
        for slots in rounds
        if way in slots and slots[way].figures_ms.get(figure)
    ]
    if not measured:
        return None
    medians = [float(np.median(slot.figures_ms[figure])) for slot, _ in measured]
    values = np.concatenate([slot.figures_ms[figure] for slot, _ in measured])
    p50, p95, p99 = (float(value) for value in np.percentile(values, (50, 95, 99)))
    cpus = [slot.cpu_ms[figure] for slot, _ in measured if figure in slot.cpu_ms]
    ratios = [
        median / float(np.median(slots[reference[0]].figures_ms[reference[1]]))
        for median, (_, slots) in zip(medians, measured, strict=True)
        if reference[0] in slots and slots[reference[0]].figures_ms.get(reference[1])
    ]
    return Summary(
        p50,
        p95,
        p99,
        min(medians),
        max(medians),
        float(np.median(cpus)) if cpus else None,
        float(np.median(ratios)) if ratios else None,
        len(values),
    )
