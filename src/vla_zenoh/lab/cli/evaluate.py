"""vla-zenoh eval: figures and plots of recorded runs."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.output import console, errors, fail, new_table, plain_types
from vla_zenoh.lab.evaluation import tables
from vla_zenoh.lab.evaluation.evaluate import combined, evaluate, to_mapping
from vla_zenoh.lab.evaluation.result import STAGES, Evaluation

IMAGES = 8
WIDE = 110
"""Width of a terminal with room for every column, in characters."""
STDOUT = Path("-")


def evaluation(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Recordings (.mcap), CSV of the thesis, or folders of them."),
    ],
    first: Annotated[
        int | None, typer.Option("--first", help="Only this many requests of each run.", min=1)
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write everything to this file; - is stdout.")
    ] = None,
    csv_file: Annotated[
        Path | None, typer.Option("--csv", help="Write one row per run to this file; - is stdout.")
    ] = None,
    html_file: Annotated[
        Path | None, typer.Option("--html", help="Write a page with plots to this file.")
    ] = None,
    images: Annotated[
        int, typer.Option("--images", help="Images of each camera on the page.", min=0, max=50)
    ] = IMAGES,
) -> None:
    """Evaluate recorded runs: latency, motion, drift, smoothness, rejections.

    Exits with 0 if at least one file could be evaluated; stderr says which could not.
    """
    runs, faults = evaluate(paths, first, pictures=images if html_file else 0)
    if STDOUT not in (json_file, csv_file):
        _show(runs)
    for run in runs:
        for problem in run.problems:
            errors().print(f"{run.name}: {problem}", style="yellow")
    for why in faults.values():
        errors().print(f"not evaluated: {why}", style="red")
    if json_file is not None:
        _write(json_file, json.dumps(plain_types(to_mapping(runs, faults)), indent=2) + "\n")
    if csv_file is not None:
        _write(csv_file, _rows(runs))
    if html_file is not None:
        from vla_zenoh.lab.evaluation.report import page

        _write(html_file, page(runs, faults))
    if not runs:
        fail("nothing could be evaluated")


def _write(path: Path, text: str) -> None:
    if path == STDOUT:
        sys.stdout.write(text)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror}")


def _rows(runs: Sequence[Evaluation]) -> str:
    rows = [run.row() for run in (*runs, *([combined(runs)] if len(runs) > 1 else ()))]
    names = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def _show(runs: Sequence[Evaluation]) -> None:
    if not runs:
        return
    screen = console()
    shown_columns = None if screen.width >= WIDE else tables.NARROW
    columns = tables.SUMMARY_COLUMNS[:shown_columns]
    table = new_table(*columns, left=("run",))
    for run in runs:
        row = tables.summary_row(run)[:shown_columns]
        table.add_row(*row)
    if len(runs) > 1:
        table.add_section()
        table.add_row(*tables.summary_row(combined(runs))[:shown_columns], style="bold")
    screen.print(table)
    shown = runs[0] if len(runs) == 1 else combined(runs)
    _show_latency([*runs, shown] if len(runs) > 1 else runs)
    if len(runs) == 1:
        _show_segments(shown)
    for name, value in tables.figures(shown):
        screen.print(f"{name}: {value}")


def _show_latency(runs: Sequence[Evaluation]) -> None:
    several, wide = len(runs) > 1, console().width >= WIDE
    columns = (*(["run"] if several else []), "stage", *tables.LATENCY_COLUMNS)
    columns += ("",) if wide else ()
    table = new_table(*columns, title="latency in ms", left=("run", "stage", ""))
    for run in runs:
        name = run.name
        for index, row in enumerate(tables.latency_rows(run)):
            first = [name if index == 0 else ""] if several else []
            table.add_row(*first, *row, *([STAGES[row[0]]] if wide else []))
        table.add_section()
    if table.row_count:
        console().print(table)


def _show_segments(run: Evaluation) -> None:
    columns, rows = tables.filled(tables.SEGMENT_COLUMNS, tables.segment_rows(run))
    table = new_table(*columns, title="asked and reached", left=("prompt",))
    for row in rows:
        table.add_row(*row)
    if rows:
        console().print(table)
