"""The figures of `python -m benchmarks serving`: age of a chunk over the number of robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh_figures.style import COLUMN_IN, PAGE_IN, Drawn, look, panels, styled, write

BATCHED, ALONE = "batched", "alone"
LEROBOT = "lerobot"
LABELS = {
    "openpi": "openpi's server",
    "groot": "GR00T's ZeroMQ",
    LEROBOT: "LeRobot's gRPC, a server each",
    ALONE: "vla-zenoh, one robot at a time",
    BATCHED: "vla-zenoh",
}
"""Ways of serving."""
NOT_DRAWN = "groot"
"""Its curve is that of openpi's server."""
DRAWN_GROWTHS = (None, 0.15, 1.0)
SIZES_IN = {"": COLUMN_IN, "_page": PAGE_IN}
"""What the name of a file has -> its width."""
HEIGHT_IN, KINDS = 1.6, ("svg", "png", "pdf")
TICKS_MS = (20, 50, 100, 200, 500, 1000, 2000, 5000)
AGES = {"age_p95_ms": "on arrival, p95 (ms)", "held_p95_ms": "held, p95 (ms)"}
ROOM = 1.25
CAPTION = (
    "Age of a chunk, from the camera's stamp to its arrival at the robot, and of the newest image "
    "that a robot has a chunk of, at any time; over the robots of one model of cost "
    "c (1 + k (n - 1)) ms for n robots at once."
)


def write_figures(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Draw the rows of one raw camera in both widths; the files."""
    rows = [
        row
        for row in rows
        if row["way"] != NOT_DRAWN
        and row["growth"] in DRAWN_GROWTHS
        and row["cameras"] == 1
        and not row["jpeg"]
    ]
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for suffix, width_in in SIZES_IN.items():
        drawn = age_over_robots(rows, width_in)
        for kind in KINDS:
            files.append(folder / f"serving{suffix}.{kind}")
            write(drawn, files[-1])
    return files


@styled
def age_over_robots(rows: Sequence[Mapping[str, Any]], width_in: float) -> Drawn:
    """The ages of each cost: below one another, or beside one another on a page, where there is the
    age while a chunk is held as well."""
    from matplotlib.figure import Figure

    costs = sorted({row["model_ms"] for row in rows})
    curves = list(dict.fromkeys(label(row) for row in sorted(rows, key=_order)))
    wide = width_in > COLUMN_IN
    if wide:
        figure = Figure(figsize=(width_in, 2 * HEIGHT_IN + 0.8), layout="constrained")
        fields = figure.subplots(len(AGES), len(costs), sharex=True, sharey="row", squeeze=False)
    else:
        figure, column = panels(len(costs), width_in, HEIGHT_IN)
        fields = [column]
    for age, axes in zip(AGES, fields, strict=False):
        for cost_ms, axis in zip(costs, axes, strict=True):
            chosen = [row for row in rows if row["model_ms"] == cost_ms]
            _draw(axis, chosen, curves, age)
            seen = [row[age] for row in (rows if wide else chosen)]
            axis.set_ylim(min(seen) / ROOM, max(seen) * ROOM)
            if not wide or cost_ms == costs[0]:
                axis.set_ylabel(AGES[age])
            if age == next(iter(AGES)):
                axis.set_title(f"c = {cost_ms:g} ms")
    counts = sorted({row["robots"] for row in rows})
    for axis in fields[-1] if wide else fields[0][-1:]:
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.set_xlabel("robots")
    handles = fields[0][costs.index(_fullest_cost(rows))].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=2 if wide else 1)
    return Drawn(figure, CAPTION)


def _draw(axis: Any, rows: Sequence[Mapping[str, Any]], curves: Sequence[str], age: str) -> None:
    for index, name in enumerate(curves):
        points = sorted((row["robots"], row[age]) for row in rows if label(row) == name)
        if not points:
            continue
        mine = look(index, len(curves))
        drawn = {"color": mine.colour, "linestyle": mine.dash, "marker": mine.marker}
        axis.plot(*zip(*points, strict=True), label=name, markersize=3.0, **drawn)
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.set_yticks(TICKS_MS, [str(tick) for tick in TICKS_MS])
    axis.minorticks_off()


def _order(row: Mapping[str, Any]) -> tuple[int, float]:
    return list(LABELS).index(row["way"]), row["growth"] or 0.0


def _fullest_cost(rows: Sequence[Mapping[str, Any]]) -> float:
    """That has most curves."""
    curves = {(row["model_ms"], label(row)) for row in rows}
    costs = [cost_ms for cost_ms, _ in curves]
    return max(sorted(set(costs)), key=costs.count)


def label(row: Mapping[str, Any]) -> str:
    """Name of the curve that a row belongs to."""
    growth = "" if row["growth"] is None else f", k = {row['growth']:g}"
    return LABELS[row["way"]] + growth
