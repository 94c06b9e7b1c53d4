"""The flywheel's figures for a paper: loss of the training, and success over delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

from vla_zenoh_figures.style import COLUMN_IN, Drawn, look, panels, styled, write

HEIGHT_IN, KINDS = 1.5, ("svg", "pdf")
APART_MS = 7.0
"""Between lines at one delay, so that no interval hides another."""
WORDS = {
    "stand": "arm stands meanwhile",
    "replace": "old chunk runs on, replaced",
    "blend": "old chunk runs on, blended",
}


def write_figures(folder: Path, rows: Mapping[str, Any]) -> list[Path]:
    """Draw what the rows have; the files."""
    drawn = dict[str, Drawn]()
    if "training" in rows:
        drawn["flywheel_training"] = training(rows["training"])
    delays = [name for name in rows if name.endswith("ms")]
    if delays:
        drawn["flywheel_delay"] = success_over_delay([rows[name] for name in delays], delays)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{name}.{kind}" for name in drawn for kind in KINDS]
    for file in files:
        write(drawn[file.stem], file)
    return files


@styled
def training(row: Mapping[str, Any]) -> Drawn:
    """Mean error of the actions in the training set, over epochs."""
    figure, (axis,) = panels(1, COLUMN_IN, HEIGHT_IN)
    epochs, loss = zip(*row["l1_by_epoch"], strict=True)
    axis.plot(epochs, loss, color=look(0, 1).colour)
    axis.set_ylim(0.0, 1.05 * max(loss))
    axis.set_xlabel("epoch")
    axis.set_ylabel("mean L1, normalized")
    return Drawn(figure, f"Training of ACT: {row['steps']} steps, {epochs[-1]:.1f} epochs.")


@styled
def success_over_delay(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Drawn:
    """Success of one policy and its steps over the delay of its chunks, by what the arm does."""
    figure, (success, steps) = panels(2, COLUMN_IN, HEIGHT_IN)
    ways = [way for way in WORDS if any(name.startswith(way) for name in names)]
    for index, way in enumerate(ways):
        own = [row for row, name in zip(rows, names, strict=True) if name.startswith(way)]
        mine, apart = look(index, len(ways)), APART_MS * (index - (len(ways) - 1) / 2)
        at_ms = [row["delay_ms"] + apart for row in own]
        for place, row in zip(at_ms, own, strict=True):
            interval = [100 * share for share in row["wilson_95"]]
            success.plot([place, place], interval, color=mine.colour, linewidth=1.2)
        drawn = {"color": mine.colour, "linestyle": mine.dash, "marker": mine.marker}
        share = [100 * row["success_rate"] for row in own]
        success.plot(at_ms, share, label=WORDS[way], markersize=4.0, **drawn)
        taken = [row["steps_to_success_p50"] or nan for row in own]
        steps.plot(at_ms, taken, markersize=4.0, **drawn)
    success.set_ylim(0.0, 103.0)
    success.set_ylabel("success rate (%)")
    steps.set_ylim(bottom=0.0)
    steps.set_ylabel("steps to success")
    steps.set_xticks(sorted({row["delay_ms"] for row in rows}))
    steps.set_xlabel("inference (ms)")
    figure.legend(loc="outside upper center", ncols=1)
    seeds = [each["seed"] for each in rows[0]["all"]]
    caption = (
        f"Success with its interval at 95 % (Wilson), n = {len(seeds)} episodes a point, seeds "
        f"{seeds[0]} to {seeds[-1]}; median steps of the episodes that succeeded."
    )
    return Drawn(figure, caption)
