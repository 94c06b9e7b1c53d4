"""vla-zenoh bench compare: whether one model does more tasks than another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console, new_table
from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.bench.paired_tasks import CONDITIONS, Comparison, figures, read_run
from vla_zenoh.lab.bench.paired_tasks import compare as compare_runs
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.statistics import ALPHA

B_IS_WORSE = 3
"""Exit code; 1 and 2 are those of every command for errors."""
DISAGREEMENTS = 10


def compare(
    a: Annotated[
        Path, typer.Argument(help="Result of `bench task` or `sim`: folder or JSON.", metavar="A")
    ],
    b: Annotated[Path, typer.Argument(help="Another one.", metavar="B")],
    differ: Annotated[
        list[str] | None,
        typer.Option(
            "--differ",
            help=f"Condition that may differ, besides the model; repeatable: "
            f"{', '.join(CONDITIONS)}.",
        ),
    ] = None,
    tasks: Annotated[bool, typer.Option("--tasks", help="A row per task, too.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare two runs of `bench task` or `bench sim` on the layouts that both have.

    Exits with 3 if B is worse than A (p below 0.05), with 1 if the runs cannot be compared, else
    with 0.
    """
    unknown = [name for name in differ or () if name not in CONDITIONS]
    if unknown:
        raise typer.BadParameter(f"--differ {unknown[0]!r}: {', '.join(CONDITIONS)}")
    first, second = (read_run(_bytes(path), str(path)) for path in (a, b))
    found = compare_runs(first, second, differ or ())
    if as_json:
        print_json(found.to_dict())
    else:
        _print(found, tasks=tasks)
    if found.b_is_worse:
        raise typer.Exit(B_IS_WORSE)


def _bytes(path: Path) -> bytes:
    try:
        return (path / "result.json" if path.is_dir() else path).read_bytes()
    except OSError as error:
        raise ResourceError(f"{path} cannot be read: {error.strerror}") from error


def _print(found: Comparison, *, tasks: bool) -> None:
    result = found.to_dict()
    out = console()
    for name, run in (("A", result["a"]), ("B", result["b"])):
        options = ", ".join(f"{k}={v}" for k, v in run["options"].items())
        given = f" ({options})" if options else ""
        out.print(f"{name}: {run['model']}{given}, {run['episodes']} episodes", soft_wrap=True)
    for name, (one, other) in result["differ"].items():
        out.print(f"{name}: {one} in A, {other} in B", soft_wrap=True)
    columns = ("pairs", "A", "B", "both", "only A", "only B", "neither", "B - A", "95 %", "p")
    table = new_table("", *columns, left=("",))
    _row(table, "all", figures(found.counts))
    for part in ("by_family", *(["by_task"] if tasks else [])):
        table.add_section()
        for name, row in result[part].items():
            _row(table, name, row)
    out.print(table)
    differing = list(found.disagreements())
    for each in differing[:DISAGREEMENTS]:
        who, why = each["done_by"].upper(), each["failure_of_the_other"]
        out.print(f"- {each['seed']}, {each['task']}: done by {who} alone, the other: {why}")
    if len(differing) > DISAGREEMENTS:
        out.print(f"- and {len(differing) - DISAGREEMENTS} more, with --json")
    only_a, only_b = found.unpaired
    if only_a or only_b:
        out.print(f"left out, in only one of the runs: {only_a} of A, {only_b} of B")
    out.print(_verdict(found), soft_wrap=True)


def _row(table: Table, name: str, row: dict[str, Any]) -> None:
    interval = row["difference_95"]
    table.add_row(
        name,
        str(row["pairs"]),
        f"{row['rate_a']:.1%}",
        f"{row['rate_b']:.1%}",
        *(str(row[part]) for part in ("both", "only_a", "only_b", "neither")),
        f"{row['difference']:+.1%}",
        "" if interval is None else f"{interval[0]:+.1%}..{interval[1]:+.1%}",
        f"{row['p']:.2g}",
    )


def _verdict(found: Comparison) -> str:
    counts = found.counts
    if counts.too_few:
        return f"{counts.too_few} (p = {counts.p:.2g})."
    if counts.p >= ALPHA:
        interval = counts.stated_95
        between = (
            ""
            if interval is None
            else f", B's rate minus A's is between {interval[0]:+.1%} and {interval[1]:+.1%}"
        )
        return f"No significant difference: p = {counts.p:.2g}{between}."
    word = "fewer" if found.b_is_worse else "more"
    return f"B does {word} of the same tasks than A: p = {counts.p:.2g}."
