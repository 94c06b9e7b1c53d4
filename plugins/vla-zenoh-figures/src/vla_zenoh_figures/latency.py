"""How long requests took, as cumulative distributions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vla_zenoh.lab.evaluation.result import STAGES, Evaluation
from vla_zenoh.lab.statistics import distribution
from vla_zenoh_figures.style import Drawn, FigureError, look, panels, styled

HEIGHT_IN = 1.9


@styled
def latency(runs: Sequence[Evaluation], width_in: float, stage: str) -> Drawn:
    """Share of the requests of each run that took at most a time.

    Args:
        stage: one of `STAGES`.
    """
    figure, (axis,) = panels(1, width_in, HEIGHT_IN)
    words = [f"Latency, {STAGES[stage]}: share of the requests that took at most this long."]
    for index, run in enumerate(runs):
        values_ms = np.asarray(run.stages_ms.get(stage, ()), np.float64)
        found = distribution(values_ms)
        if found is None:
            raise FigureError(f"{run.name} has no request whose stage {stage} is known")
        mine = look(index, len(runs))
        sorted_ms = np.sort(values_ms[np.isfinite(values_ms)])
        share = np.arange(1, found.count + 1) / found.count
        axis.step(
            np.r_[sorted_ms[0], sorted_ms],
            np.r_[0.0, share],
            where="post",
            color=mine.colour,
            linestyle=mine.dash,
            label=f"{run.name}, n = {found.count}",
        )
        for part, at_ms in ((0.5, found.p50), (0.95, found.p95)):
            axis.plot([at_ms], [part], mine.marker, color=mine.colour, markersize=4)
        words.append(
            f"{run.name}: n = {found.count} requests, median {found.p50:.1f} ms, 95th percentile "
            f"{found.p95:.1f} ms, largest {found.max:.1f} ms."
        )
    words.append("Marks: median and 95th percentile.")
    axis.set_xlabel("latency (ms)")
    axis.set_ylabel("share of requests")
    axis.set_ylim(0.0, 1.02)
    figure.legend(loc="outside upper center", ncols=1)
    return Drawn(figure, " ".join(words))
