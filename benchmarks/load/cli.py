"""python -m benchmarks load."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Table
from vla_zenoh_benchmarks.result_file import ResultOptions, kept_rows

from vla_zenoh.cli.options import DEFAULT_PROFILE, effective_profile, options
from vla_zenoh.cli.output import errors
from vla_zenoh.lab.cli.options import number_list

MOST = 64


@options
def load(
    output: ResultOptions,
    robots: Annotated[
        str, typer.Option("--robots", help="Numbers of robots, separated by commas; empty: none.")
    ] = "1,2,4,8,16",
    cameras: Annotated[
        str, typer.Option("--cameras", help="Numbers of cameras, in the same form.")
    ] = "1,2,4,8",
    seconds: Annotated[
        float, typer.Option("--seconds", min=3, max=600, help="How long at each number.")
    ] = 10.0,
    model_ms: Annotated[
        float | None,
        typer.Option(
            "--model-ms", min=1, help="Cost c of an inference; default: the scripted model."
        ),
    ] = None,
    growth: Annotated[
        float, typer.Option("--growth", min=0, max=1, help="Share k that each further robot adds.")
    ] = 0.15,
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
    ] = DEFAULT_PROFILE,
) -> None:
    """Measure how many robots and cameras one router and this computer carry.

    Robots follow their commands without a simulator; one worker serves all of them, with --model-ms
    a model that costs c (1 + k (n - 1)) for n robots at once. Cameras send images of 640x480, which
    are read raw.
    """
    from benchmarks.load.runner import Load
    from vla_zenoh.lab.cli.loopback import own_address
    from vla_zenoh.runtime.process import die_with_parent, stop_on_signals

    robot_counts, camera_counts = _counts("--robots", robots), _counts("--cameras", cameras)
    stop = stop_on_signals()
    die_with_parent()
    loaded = own_address(effective_profile(profile))
    declared = None
    if model_ms is not None:
        declared = {"cost_ms": f"{model_ms:g}", "growth": f"{growth:g}"}
    with kept_rows(output, _tables) as rows:
        for counts, make in ((robot_counts, "robots"), (camera_counts, "cameras")):
            if not counts:
                continue
            with Load(loaded, stop, rows.log, declared) as running:
                for row in getattr(running, make)(counts, seconds):
                    rows.append(row)
                    errors().print(f"{row[make]} {make} measured", style="dim")


ROBOT_COLUMNS = {
    "active": "active",
    "command_hz": "pose Hz",
    "missed_ticks": "missed",
    "late_p99_us": "late us p99",
    "state_hz": "state Hz",
    "chunks_hz": "chunks Hz",
    "latency_p50_ms": "ms p50",
    "latency_p95_ms": "ms p95",
}
CAMERA_COLUMNS = {
    "camera_hz": "camera Hz",
    "mib_s": "MiB/s",
    "latency_p50_ms": "ms p50",
    "latency_p95_ms": "ms p95",
}


def _tables(rows: list[dict[str, Any]]) -> Iterator[Table]:
    for title, kind, columns in (
        ("Robots", "robots", ROBOT_COLUMNS),
        ("Cameras of 640x480 at 30 Hz, raw", "cameras", CAMERA_COLUMNS),
    ):
        chosen = [row for row in rows if row[kind]]
        if chosen:
            yield _table(title, kind, columns, chosen)


def _table(title: str, kind: str, columns: dict[str, str], rows: list[dict[str, Any]]) -> Table:
    table = Table(box=SIMPLE, pad_edge=False, title=title)
    table.add_column(kind, justify="right")
    for column in (*columns.values(), "cores", "holds"):
        table.add_column(column, justify="right", no_wrap=column != "cores")
    for row in rows:
        cores = ", ".join(f"{name} {share:g}" for name, share in row["cores"].items())
        table.add_row(
            str(row[kind]),
            *(f"{row[name]:g}" for name in columns),
            f"{sum(row['cores'].values()):.2f} ({cores})",
            "yes" if row["held"] else "no",
        )
    return table


def _counts(option: str, text: str) -> list[int]:
    numbers = number_list(option, text, 1, MOST) if text.strip() else []
    if any(number != int(number) for number in numbers):
        raise typer.BadParameter(f"{option} wants whole numbers")
    return sorted({int(number) for number in numbers})
