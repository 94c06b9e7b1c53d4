"""How often models did their tasks, with the interval of each rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from vla_zenoh_benchmarks.paired_tasks import PairedOutcome, TaskResultFile
from vla_zenoh_benchmarks.statistics import wilson_95

from vla_zenoh_figures.style import Drawn, FigureError, look, panels, styled

ROW_IN, APART = 0.24, 0.18
ALL = "all"


class Result(NamedTuple):
    """A result of ``bench task`` or ``bench sim``, and its name in the figure."""

    name: str
    file: TaskResultFile


@styled
def success(results: Sequence[Result], width_in: float) -> Drawn:
    """Success rates by kind of task and of all, each with its interval at 95 % (Wilson)."""
    empty = [each.name for each in results if not each.file.all]
    if empty:
        raise FigureError(f"no episode in: {', '.join(empty)}")
    families = list(dict.fromkeys(done.family for each in results for done in each.file.all))
    rows = [*families, ALL] if len(families) > 1 else [ALL]
    height_in = ROW_IN * len(rows) * max(2, len(results)) / 2 + 0.3
    figure, (axis,) = panels(1, width_in, height_in)
    words = ["Success rate with its interval at 95 % (Wilson)."]
    for index, each in enumerate(results):
        mine = look(index, len(results))
        for place, row in enumerate(rows):
            done, tried = _counts(each.file.all, row)
            if not tried:
                continue
            low, high = wilson_95(done, tried)
            at = place + APART * (index - (len(results) - 1) / 2)
            axis.plot([100 * low, 100 * high], [at, at], color=mine.colour, linewidth=1.2)
            label = each.name if row == ALL else None
            marker = {"marker": mine.marker, "markersize": 4.5, "linestyle": ""}
            axis.plot([100 * done / tried], [at], color=mine.colour, label=label, **marker)
        words.append(_about(each))
    axis.set_yticks(range(len(rows)), rows)
    axis.invert_yaxis()
    axis.set_xlim(-1, 101)
    axis.set_xlabel("success rate (%)")
    figure.legend(loc="outside upper center", ncols=2)
    return Drawn(figure, " ".join(words))


def _counts(episodes: Sequence[PairedOutcome], row: str) -> tuple[int, int]:
    mine = [each for each in episodes if row in (ALL, each.family)]
    return sum(each.success for each in mine), len(mine)


def _about(result: Result) -> str:
    seeds = sorted({each.seed for each in result.file.all})
    done, tried = _counts(result.file.all, ALL)
    low, high = wilson_95(done, tried)
    which = (
        f"seed {seeds[0]}" if len(seeds) == 1 else f"{len(seeds)} seeds, {seeds[0]} to {seeds[-1]}"
    )
    return (
        f"{result.name}: {done} of n = {tried} episodes ({100 * low:.0f} to {100 * high:.0f} %), "
        f"{which}, {result.file.mode}, delay {result.file.delay_ms:g} ms."
    )
