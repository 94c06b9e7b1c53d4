"""Curves of a run as a PNG."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.evaluation.result import Evaluation
from vla_zenoh.lab.evaluation.timelines import Panel, bar_width_s, panels

WIDTH_IN, ROW_IN, HEAD_IN, LINE_IN = 11.0, 1.55, 0.75, 0.17
DPI = 100
KEY_CHARACTERS = 140
TITLE = ("profile", "model", "recorded")
"""Facts of the run that follow its name."""


def write_plot(path: Path, run: Evaluation) -> bool:
    """Draw the curves of a run, one panel below the other; returns whether there were any.

    Prompts are numbered; the numbers stand above the curves and are explained in the head.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError as error:
        raise MissingExtraError("matplotlib", "sim") from error
    shown = panels(run)
    if not shown:
        return False
    names = "    ".join(
        f"{number}\u00a0{prompt.removeprefix('HARD: ').replace(' ', chr(0xA0))}"
        for number, (_, prompt) in enumerate(run.marks, 1)
    )
    key = textwrap.wrap(names, KEY_CHARACTERS)
    head_in = HEAD_IN + LINE_IN * len(key)
    height_in = head_in + ROW_IN * len(shown)
    figure, rows = plt.subplots(
        len(shown), 1, sharex=True, squeeze=False, figsize=(WIDTH_IN, height_in)
    )
    figure.subplots_adjust(
        left=0.065, right=0.985, top=1 - head_in / height_in, bottom=0.5 / height_in, hspace=0.42
    )
    top = {"x": 0.012, "ha": "left", "va": "top"}
    figure.text(
        y=1 - 0.1 / height_in,
        s=", ".join([run.name, *(run.about[name] for name in TITLE if name in run.about)]),
        size=13,
        weight="bold",
        **top,
    )
    figure.text(y=1 - 0.36 / height_in, s="\n".join(key), size=8.5, color="#444444", **top)
    for axes, panel in zip(rows[:, 0], shown, strict=True):
        _draw(axes, panel)
        for t_s, _ in run.marks:
            axes.axvline(t_s, color="#8894a0", lw=0.8, ls=":", zorder=0)
    for number, (t_s, _) in enumerate(run.marks, 1):
        rows[0, 0].annotate(
            str(number),
            (t_s, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 18),
            textcoords="offset points",
            ha="center",
            size=8,
            bbox={"boxstyle": "round,pad=0.25", "fc": "white", "ec": "#8894a0", "lw": 0.7},
        )
    rows[-1, 0].set_xlabel("time (s)")
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return True


def _draw(axes: Any, panel: Panel) -> None:
    axes.set_ylabel(panel.unit)
    axes.grid(alpha=0.25)
    axes.margins(x=0.01)
    if panel.stacked:
        below = np.zeros(len(panel.curves[0].t_s))
        for curve in panel.curves:
            width_s = bar_width_s(curve)
            axes.bar(curve.t_s, curve.values, width_s, bottom=below, color=curve.colour)
            below = below + np.nan_to_num(curve.values)
    for curve in panel.curves if not panel.stacked else ():
        width, alpha = (3.5, 0.3) if curve.halo else (1.0, 1.0)
        axes.plot(curve.t_s, curve.values, color=curve.colour, lw=width, alpha=alpha)
    # The words of a legend stand in the line above the curves, where they cover nothing.
    words = [(f"{panel.title}, {panel.unit}   ", "#222222")]
    labels = {curve.name: curve.colour for curve in panel.curves}
    words += [(f"{name}  ", colour) for name, colour in labels.items()]
    words += [(f" {panel.note}", "#666666")] if panel.note else []
    at: Any = (0.0, 1.0)
    for index, (word, colour) in enumerate(words):
        at = axes.annotate(
            word,
            at if index == 0 else (1.0, 0.0),
            xycoords="axes fraction" if index == 0 else at,
            xytext=(0, 4) if index == 0 else (0, 0),
            textcoords="offset points",
            size=9,
            color=colour,
            weight="bold" if 0 < index <= len(labels) else "normal",
            va="bottom",
        )
