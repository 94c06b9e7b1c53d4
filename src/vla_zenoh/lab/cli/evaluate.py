"""vla-zenoh eval: figures and plots of recorded runs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console, errors, fail, new_table
from vla_zenoh.cli.plain import warn
from vla_zenoh.lab.cli.output import plain_types, print_json, progress_bars
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
from vla_zenoh.lab.evaluation import tables
from vla_zenoh.lab.evaluation.evaluate import EMPTY, combined, evaluate, recordings, to_mapping
from vla_zenoh.lab.evaluation.result import STAGES, Evaluation

IMAGES = 8
WIDE = 110
"""Width of a terminal with room for every column, in characters."""
HTML, CSV = ".html", ".csv"
KINDS = (HTML, CSV, ".json")
"""Ends of the names of the files that can be written."""


def evaluation(
    paths: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or folders of them.")],
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            help="File to write; repeatable. .html: a page with plots; .csv: a row per run; "
            ".json: everything.",
        ),
    ] = None,
    images: Annotated[
        int, typer.Option("--images", help="Images of each camera on the page.", min=0, max=50)
    ] = IMAGES,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Evaluate recorded runs: latency, motion, drift, smoothness, rejections.

    Exits with 0 if at least one file could be evaluated; stderr says which could not.
    """
    kinds = [_kind(path) for path in output or ()]
    # Before the outputs are made, which may lie in the same folder.
    found = {path: list(recordings([path])) for path in paths}
    files = [file for inside in found.values() for file in inside]
    with ExitStack() as stack:
        parts = [
            stack.enter_context(output_file(path, force=force, inputs=files))
            for path in output or ()
        ]
        with progress_bars(24) as bars:
            bar = bars.add_task("evaluating", total=len(files))
            runs, faults = evaluate(
                files,
                pictures=images if HTML in kinds else 0,
                evaluated=lambda path: bars.update(bar, advance=1, description=path.name),
            )
        faults |= {str(path): EMPTY.format(path) for path in paths if not found[path]}
        print_json(to_mapping(runs, faults)) if as_json else _show(runs)
        for run in runs:
            for problem in run.problems:
                warn(f"{run.name}: {problem}")
        for why in faults.values():
            errors().print(f"not evaluated: {why}", style="red")
        if not runs:
            fail("nothing could be evaluated")
        for kind, part in zip(kinds, parts, strict=True):
            part.write_text(_text(kind, runs, faults), "utf-8")


def _kind(path: Path) -> str:
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise typer.BadParameter(f"--output {path}: its name must end in {', '.join(KINDS)}")
    return kind


def _text(kind: str, runs: Sequence[Evaluation], faults: Mapping[str, str]) -> str:
    if kind == CSV:
        return _rows(runs)
    if kind == HTML:
        from vla_zenoh.lab.evaluation.report import page

        return page(runs, faults)
    return json.dumps(plain_types(to_mapping(runs, faults)), indent=2) + "\n"


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
