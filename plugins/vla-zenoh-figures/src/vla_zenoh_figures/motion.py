"""How the TCP moved in one run or several: measured, and what was commanded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.lab.evaluation.result import Evaluation, PlotTrace
from vla_zenoh.lab.evaluation.timelines import thinned, unbroken
from vla_zenoh.lab.statistics import distribution
from vla_zenoh.types import FloatArray
from vla_zenoh_figures.style import ASKED, Drawn, FigureError, look, panels, styled

PANEL_IN = 0.95
Values = Callable[[PlotTrace], tuple[FloatArray, FloatArray]]


class Row(NamedTuple):
    """One panel. `of` returns times (n,) in s and values (n,) of a trace.

    `least` is the smallest range that is shown: an arm at rest is a line, not its noise.
    """

    label: str
    of: Values
    least: float


def _axis(index: int) -> Values:
    def values(trace: PlotTrace) -> tuple[FloatArray, FloatArray]:
        t_s, position_m = unbroken(trace)
        return t_s, position_m[:, index]

    return values


def _turned(trace: PlotTrace) -> tuple[FloatArray, FloatArray]:
    t_s, rotvec_rad = unbroken(trace, "rotvec_rad")
    return t_s, np.linalg.norm(rotvec_rad, axis=1)


def _speed(trace: PlotTrace) -> tuple[FloatArray, FloatArray]:
    if not len(trace.speed_m_s):
        return np.zeros(0), np.zeros(0)
    return unbroken(trace, "speed_m_s")


ROWS = (
    Row("x (m)", _axis(0), 0.01),
    Row("y (m)", _axis(1), 0.01),
    Row("z (m)", _axis(2), 0.01),
    Row("turned (rad)", _turned, 0.02),
    Row("speed (m/s)", _speed, 0.02),
)


@styled
def motion(runs: Sequence[Evaluation], width_in: float) -> Drawn:
    """Position, rotation since the start and speed of the TCP over the time since the first prompt.

    Args:
        runs: measured, each in its own colour and dashes; of one alone what was commanded, too.
    """
    without = [run.name for run in runs if run.measured is None]
    if without:
        raise FigureError(f"no measured pose in: {', '.join(without)}")
    figure, axes = panels(len(ROWS), width_in, PANEL_IN)
    for index, run in enumerate(runs):
        began_s = run.marks[0][0] if run.marks else 0.0
        mine = look(index, len(runs))
        assert run.measured is not None
        for row, axis in zip(ROWS, axes, strict=True):
            if len(runs) == 1 and run.commanded is not None:
                t_s, values = thinned(*row.of(run.commanded))
                axis.plot(t_s - began_s, values, color=ASKED, linewidth=2.5, label="commanded")
            t_s, values = thinned(*row.of(run.measured))
            label = "measured" if len(runs) == 1 else run.name
            axis.plot(t_s - began_s, values, color=mine.colour, linestyle=mine.dash, label=label)
    for row, axis in zip(ROWS, axes, strict=True):
        axis.set_ylabel(row.label)
        low, high = axis.get_ylim()
        more = max(0.0, row.least - (high - low)) / 2
        axis.set_ylim(low - more, high + more)
    figure.align_ylabels(axes)
    axes[-1].set_xlabel("time since the first prompt (s)" if runs[0].marks else "time (s)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    return Drawn(figure, " ".join(["Motion of the TCP.", *map(_about, runs)]))


def _about(run: Evaluation) -> str:
    words = [f"{run.name}: prompts n = {len(run.marks)}, chunks n = {run.requests}"]
    if run.path_m is not None:
        words.append(f"path {run.path_m:.3f} m")
    if apart := distribution(run.tracking_mm):
        words.append(
            f"measured to commanded position at the same time: median {apart.p50:.1f} mm, "
            f"95th percentile {apart.p95:.1f} mm"
        )
    return f"{', '.join(words)}."
