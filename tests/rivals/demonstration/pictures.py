"""The picture of the demonstration: how high both arms were, and what the arm pressed with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot
from vla_zenoh_figures.style import ASKED, LOOKS, PAGE_IN, SIZES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEIGHT_IN = 3.0
BEFORE_S, AFTER_S = 0.6, 3.4
"""Of the cut, in the second part of the picture."""
NAMES = {
    "widowx": "WidowX AI, by Trossen's library on its simulated controller",
    "owned": "arm that an owner process of physicalai holds",
}
CLOSE = ("cut", "stands", "brakes", "agent told")
"""Marks of the second part; the first has all but the two in the middle."""
TOP, ROW, ROWS, MARK_PT = 0.98, 0.07, 4, 6.0


def mark(axes: Axes, marks: list[tuple[float, str]]) -> None:
    """A line and a word at each time, in rows that do not touch."""
    for number, (at_s, text) in enumerate(marks):
        axes.axvline(at_s, color=ASKED, lw=0.5)
        place = axes.get_xaxis_transform()
        height = TOP - ROW * (number % ROWS)
        axes.text(at_s, height, f" {text}", transform=place, fontsize=MARK_PT, va="top")


def headroom(axes: Axes) -> None:
    """Room for the words above the lines."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.4 * (high - low))


def draw(story: dict[str, Any], file: Path) -> None:
    """Write the picture of a told story, as SVG and PNG."""
    marked = [(step["t_s"], step["mark"]) for step in story["steps"] if step["mark"]]
    cut_s = next(at_s for at_s, text in marked if text == "cut")
    with pyplot.rc_context(SIZES):
        figure, (whole, close, forces) = pyplot.subplots(
            *(1, 3), figsize=(PAGE_IN, HEIGHT_IN), width_ratios=[3, 2.4, 0.8], layout="constrained"
        )
        for (name, track), look in zip(story["tracks"].items(), LOOKS, strict=False):
            style: dict[str, Any] = {"color": look.colour, "ls": look.dash}
            whole.plot(track["t_s"], track["z_m"], **style, label=NAMES[name])
            rows = [
                (t_s - cut_s, z_m)
                for t_s, z_m in zip(track["t_s"], track["z_m"], strict=True)
                if -BEFORE_S <= t_s - cut_s <= AFTER_S
            ]
            if name == "widowx":
                close.plot(*zip(*rows, strict=True), **style)
        headroom(whole)
        headroom(close)
        mark(whole, [(at_s, text) for at_s, text in marked if text not in CLOSE[1:3]])
        after = [(at_s - cut_s, text) for at_s, text in marked if text in CLOSE]
        mark(close, [(at_s, f"{text} {at_s:.3f} s" if at_s else text) for at_s, text in after])
        whole.set_xlabel("s")
        whole.set_ylabel("height of the TCP (m)")
        close.set_xlabel("s after the cut")
        figure.legend(loc="outside upper left", ncols=2)
        pressed_n = story["pressed_n"]
        forces.bar(
            ["alone", "with\nus"], [pressed_n["without"], pressed_n["with"]], color="#0072b2"
        )
        forces.set_ylabel("force on the table (N)")
        for kind in (".svg", ".png"):
            figure.savefig(file.with_suffix(kind), dpi=150)
        pyplot.close(figure)
