"""python -m benchmarks thesis."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from benchmarks.thesis.csv_file import evaluate_csv
from benchmarks.thesis.published import thesis_table
from vla_zenoh.cli.options import options
from vla_zenoh.cli.output import errors, new_table
from vla_zenoh.lab.evaluation import tables
from vla_zenoh.lab.evaluation.evaluate import combined


@options
def thesis(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of the thesis (.csv), or result.json of `python -m benchmarks motion`."
        ),
    ],
    result: ResultOptions,
    first: Annotated[
        int | None, typer.Option("--first", help="Only this many requests of each recording.")
    ] = None,
) -> None:
    """Evaluate recordings of the thesis, and show our motions beside those it published."""
    runs = [evaluate_csv(path, first) for path in paths if path.suffix == ".csv"]
    rows = [row for path in paths if path.suffix == ".json" for row in json.loads(path.read_text())]
    for run in runs:
        for problem in run.problems:
            errors().print(f"{run.name}: {problem}", style="yellow")
    shown = [*runs, *([combined(runs)] if len(runs) > 1 else [])]
    table = new_table(*tables.SUMMARY_COLUMNS, left=("run",))
    for run in shown:
        table.add_row(*tables.summary_row(run))
    found = [run.row() for run in shown]
    with result.open() as file:
        write_json(file, found)
    result.show(found, *([table] if runs else []), *([thesis_table(rows)] if rows else []))
