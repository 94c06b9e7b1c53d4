"""The figure of `python -m benchmarks serving`: age of a chunk over the number of robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh_figures.style import COLUMN_IN, Drawn, look, panels, styled, write

BATCHED, ALONE = "batched", "alone"
LABELS = {
    "openpi": "openpi's server",
    "zmq": "ZeroMQ, as GR00T's server",
    ALONE: "vla-zenoh, one robot at a time",
    BATCHED: "vla-zenoh",
}
"""Ways of serving."""
NOT_DRAWN = "zmq"
"""Its curve is that of openpi's server."""
HEIGHT_IN, KINDS = 1.6, ("svg", "pdf")
TICKS_MS = (20, 50, 100, 200, 500, 1000, 2000)


def write_figures(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Draw the rows; the files."""
    drawn = age_over_robots(rows)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"serving.{kind}" for kind in KINDS]
    for file in files:
        write(drawn, file)
    return files


@styled
def age_over_robots(rows: Sequence[Mapping[str, Any]]) -> Drawn:
    """p95 of the age of a chunk over the number of robots, below one another for each cost."""
    rows = [row for row in rows if row["way"] != NOT_DRAWN]
    costs = sorted({row["model_ms"] for row in rows})
    counts = sorted({row["robots"] for row in rows})
    names = sorted(map(label, rows), key=list(map(label, rows)).index)
    curves = list(dict.fromkeys(names))
    figure, fields = panels(len(costs), COLUMN_IN, HEIGHT_IN)
    for cost_ms, axis in zip(costs, fields, strict=True):
        for index, name in enumerate(curves):
            points = sorted(
                (row["robots"], row["age_p95_ms"])
                for row in rows
                if row["model_ms"] == cost_ms and label(row) == name
            )
            mine = look(index, len(curves))
            drawn = {"color": mine.colour, "linestyle": mine.dash, "marker": mine.marker}
            axis.plot(*zip(*points, strict=True), label=name, markersize=3.0, **drawn)
        axis.set_xscale("log", base=2)
        axis.set_yscale("log")
        axis.set_yticks(TICKS_MS, map(str, TICKS_MS))
        axis.minorticks_off()
        ages_ms = [row["age_p95_ms"] for row in rows if row["model_ms"] == cost_ms]
        axis.set_ylim(0.8 * min(ages_ms), 1.25 * max(ages_ms))
        axis.set_ylabel("age, p95 (ms)")
        axis.set_title(f"c = {cost_ms:g} ms")
    fields[-1].set_xticks(counts, [str(count) for count in counts])
    fields[-1].set_xlabel("robots")
    figure.legend(*fields[0].get_legend_handles_labels(), loc="outside upper center", ncols=1)
    caption = (
        "Age of a chunk, from the camera's stamp to its arrival at the robot, over the robots of "
        "one model of cost c (1 + k (n - 1)) ms for n robots at once."
    )
    return Drawn(figure, caption)


def label(row: Mapping[str, Any]) -> str:
    """Name of the curve that a row belongs to."""
    growth = "" if row["growth"] is None else f", k = {row['growth']:g}"
    return LABELS[row["way"]] + growth
