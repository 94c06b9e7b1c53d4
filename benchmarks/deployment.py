"""Cost of deployment: runs of ``vla-zenoh bench sim`` compared with one in native mode, paired."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from vla_zenoh_benchmarks.paired_tasks import Comparison, compare, read_run
from vla_zenoh_benchmarks.statistics import wilson_95

LABELS = {"live": "the arm stands meanwhile", "command": "through the command node"}
COLOURS = {"live": "#1a7f8e", "command": "#d1603d"}
HEAD = """| mode | delay | done | of | native, same episodes | difference | 95 % | p |
|---|---|---|---|---|---|---|---|"""


def deployment(
    native: Annotated[Path, typer.Argument(help="Folder of the run in native mode.")],
    runs: Annotated[list[Path], typer.Argument(help="Folders in live and command mode.")],
    picture: Annotated[Path | None, typer.Option(help="Draw it: .svg or .png.")] = None,
) -> None:
    """Print a table of success by mode and delay, over the episodes that native has too."""
    first = read_run((native / "result.json").read_bytes(), str(native))
    found: list[Comparison] = []
    for folder in runs:
        other = read_run((folder / "result.json").read_bytes(), str(folder))
        found.append(compare(first, other, ("mode", "delay_ms")))
    found.sort(key=lambda each: (each.b.mode != "live", each.b.delay_ms))
    print(HEAD)
    for each in found:
        counts = each.counts
        low, high = counts.difference_95
        print(
            f"| `{each.b.mode}` | {each.b.delay_ms:g} ms | {counts.both + counts.first} "
            f"| {counts.setups} | {counts.both + counts.second} "
            f"| {100 * counts.difference:+.1f} % | {100 * low:+.1f} to {100 * high:+.1f} % "
            f"| {counts.p:.1g} |"
        )
    if picture is not None:
        _draw(found, picture)


def _draw(found: list[Comparison], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "vla-zenoh", "svg.fonttype": "none", "font.size": 9})
    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    biggest = max(found, key=lambda each: each.counts.setups).counts
    rate = 100 * (biggest.both + biggest.second) / biggest.setups
    axes.axhline(rate, color="#808080", linestyle="--", linewidth=1)
    axes.annotate("native", (0, rate), (0, 3), textcoords="offset points", color="#606060")
    for mode, label in LABELS.items():
        column = [each for each in found if each.b.mode == mode]
        rates = [(each.counts.both + each.counts.first, each.counts.setups) for each in column]
        middle = [100 * done / of for done, of in rates]
        ends = [[100 * end for end in wilson_95(*each)] for each in rates]
        spread = [
            [value - end[0] for value, end in zip(middle, ends, strict=True)],
            [end[1] - value for value, end in zip(middle, ends, strict=True)],
        ]
        delays_ms = [each.b.delay_ms for each in column]
        axes.errorbar(
            delays_ms, middle, spread, label=label, color=COLOURS[mode], marker="o", capsize=3
        )
    axes.set(xlabel="delay of an inference, ms", ylabel="success, %", ylim=(0, 100))
    axes.legend(frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, metadata={"Date": None})
