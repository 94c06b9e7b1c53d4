"""python -m benchmarks delay: success against the delay of a chunk, by ways to join chunks.

The policy `brick` in lockstep, on a virtual clock. Every way and delay has the same layouts. Each
episode is written to a file when it has ended; the same command continues an interrupted run.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from statistics import median
from typing import Annotated, Any, NamedTuple

import typer
from vla_zenoh_benchmarks.statistics import mcnemar_exact, wilson_95
from vla_zenoh_benchmarks.task_lockstep import run_in_lockstep

from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, new_table
from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.tasks.task import TaskPlan, TaskRequest
from vla_zenoh.profile import Profile, override
from vla_zenoh.runtime.process import stop_on_signals

SEED, LIMIT_S = 7_400_000, 12.0
DELAYS_MS = (0, 50, 100, 200, 300, 400)
WAYS: Mapping[str, tuple[str, str]] = {
    "replace": ("replace", "off"),
    "blend": ("blend", "off"),
    "ensemble": ("ensemble", "off"),
    "prefix": ("replace", "on"),
}
"""Way -> composition.mode of the profile, option prefix of the policy."""

Point = tuple[str, int]


class Episode(NamedTuple):
    """A result; the time is that from activation to the verdict."""

    success: bool
    time_s: float


Outcomes = dict[Point, dict[int, Episode]]
"""Point -> seed -> outcome."""


@dataclass(frozen=True, slots=True)
class _Rest(TaskPlan):
    """A plan of which the first `skip` episodes are known."""

    skip: int = 0

    def requests(self) -> Iterator[TaskRequest]:
        return islice(TaskPlan.requests(self), self.skip, None)


def delay(
    output: Annotated[Path, typer.Option("--output", "-o", help="Episodes, a line each.")],
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="At each point.")] = 100,
    delays: Annotated[list[int], typer.Option("--delay", min=0, help="In ms.")] = DELAYS_MS,  # pyright: ignore
    ways: Annotated[list[str], typer.Option("--way", help="Of joining chunks.")] = tuple(WAYS),  # pyright: ignore
    processes: Annotated[int, typer.Option(min=1, help="At once.")] = 1,
    picture: Annotated[Path | None, typer.Option(help="Draw it: .svg or .png.")] = None,
    only_table: Annotated[bool, typer.Option("--table", help="Run nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
) -> None:
    """Measure success against delay for replace, blend, ensemble and a given prefix."""
    outcomes = read_outcomes(output)
    if not only_table:
        stop = stop_on_signals()
        profile = effective_profile("panda_bricks")
        for delay_ms, way in product(delays, ways):
            if not stop.is_set():
                known = outcomes.setdefault((way, delay_ms), {})
                plan = _plan(delay_ms, episodes, len(known))
                _run(profile, way, plan, output, known, stop, processes)
        if stop.is_set():
            raise typer.Exit(130)
    rows = table(outcomes)
    if as_json:
        print(json.dumps(rows))
    else:
        _print(rows)
    if picture is not None:
        draw(picture, rows)


def read_outcomes(path: Path) -> Outcomes:
    """Outcomes in the file; a last line that a kill cut off is removed from it.

    The episodes of a point are the first ones of its plan, without a gap.
    """
    text = path.read_text("utf-8") if path.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, "utf-8")
    found: Outcomes = {}
    for line in whole.splitlines():
        row = json.loads(line)
        episode = Episode(row["success"], row["time_s"])
        found.setdefault((row["way"], row["delay_ms"]), {})[row["seed"]] = episode
    return found


def table(outcomes: Outcomes) -> list[dict[str, Any]]:
    """One row per point, over the episodes that every way has at this delay."""
    rows: list[dict[str, Any]] = []
    for (way, delay_ms), known in sorted(outcomes.items(), key=_order):
        shared = set.intersection(*(set(o) for (_, ms), o in outcomes.items() if ms == delay_ms))
        successes = sum(known[seed].success for seed in shared)
        row: dict[str, Any] = {"way": way, "delay_ms": delay_ms, "episodes": len(shared)}
        row["successes"] = successes
        times = [known[seed].time_s for seed in shared if known[seed].success]
        row["median_s"] = median(times) if times else None
        row["wilson_95"] = wilson_95(successes, len(shared)) if shared else (0.0, 1.0)
        against = outcomes.get(("replace", delay_ms))
        if against is not None and way != "replace":
            won = sum(known[seed].success > against[seed].success for seed in shared)
            lost = sum(known[seed].success < against[seed].success for seed in shared)
            row["against_replace"] = {"won": won, "lost": lost, "p": mcnemar_exact(won, lost)}
        rows.append(row)
    return rows


def _order(item: tuple[Point, Any]) -> tuple[int, int]:
    (way, delay_ms), _ = item
    return delay_ms, list(WAYS).index(way)


def _plan(delay_ms: int, episodes: int, skip: int) -> _Rest:
    return _Rest("brick", episodes, SEED, limit_s=LIMIT_S, delay_ms=delay_ms, skip=skip)


def _run(
    profile: Profile,
    way: str,
    plan: _Rest,
    output: Path,
    known: dict[int, Episode],
    stop: threading.Event,
    processes: int,
) -> None:
    if plan.skip >= plan.episodes:
        return
    mode, prefix = WAYS[way]
    changed = override(profile, {"composition": {"mode": mode}})
    with output.open("a", encoding="utf-8") as file:
        options = {"prefix": prefix, "threads": "1"}
        runs = run_in_lockstep(changed, plan, options, None, stop, processes)
        for request, (outcome, _) in zip(plan.requests(), runs, strict=False):
            seed, delay_ms = request.seed, round(plan.delay_ms)
            row = {"way": way, "delay_ms": delay_ms, "seed": seed, "success": outcome.success}
            row |= {"failure": outcome.failure, "time_s": round(outcome.time_s, 2)}
            file.write(json.dumps(row) + "\n")
            file.flush()
            known[seed] = Episode(outcome.success, outcome.time_s)


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw success against delay, with 95 % intervals, one line per way.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        matplotlib.rcParams["svg.hashsalt"] = "delay"
        from matplotlib import pyplot as plt
    except ImportError as error:
        raise MissingExtraError("matplotlib", "dev") from error
    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
    for index, (way, marker) in enumerate(zip(WAYS, "osD^", strict=True)):
        points = [row for row in rows if row["way"] == way and row["episodes"]]
        share = [100 * row["successes"] / row["episodes"] for row in points]
        ends = [[100 * end for end in row["wilson_95"]] for row in points]
        error = [[s - e[0], e[1] - s] for s, e in zip(share, ends, strict=True)]
        apart_ms = 5.0 * (index - 1.5)  # so that intervals do not hide each other
        axes.errorbar(
            [row["delay_ms"] + apart_ms for row in points],
            share,
            yerr=list(zip(*error, strict=True)) or None,
            marker=marker,
            capsize=3,
            label=way,
        )
    axes.set(xlabel="delay of a chunk, ms", ylabel="success, % (bars: 95 %)")
    axes.set_xticks(sorted({row["delay_ms"] for row in rows}))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def _print(found: list[dict[str, Any]]) -> None:
    rows = new_table("delay", "way", "success", "95 %", "median", "won : lost to replace, p")
    for row in found:
        low, high = row["wilson_95"]
        pair = row.get("against_replace")
        rows.add_row(
            f"{row['delay_ms']} ms",
            row["way"],
            f"{row['successes']} of {row['episodes']}",
            f"{100 * low:.1f} to {100 * high:.1f} %",
            f"{row['median_s']:.1f} s" if row["median_s"] else "",
            f"{pair['won']} : {pair['lost']}, {pair['p']:.2g}" if pair else "",
        )
    console().print(rows)
