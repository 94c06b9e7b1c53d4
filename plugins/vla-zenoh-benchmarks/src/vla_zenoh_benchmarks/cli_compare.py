"""vla-zenoh compare: which of two models does more tasks, or how far their chunks differ."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console, fail, new_table
from vla_zenoh.errors import ResourceError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk
from vla_zenoh_benchmarks.disagreement import (
    AXES,
    DEFAULT_TOLERANCE_S,
    Disagreement,
    arm_state,
    disagreement,
)
from vla_zenoh_benchmarks.paired_tasks import CONDITIONS, Comparison, figures, read_run
from vla_zenoh_benchmarks.paired_tasks import compare as compare_runs
from vla_zenoh_benchmarks.statistics import ALPHA

B_IS_WORSE = 3
"""Exit code; 1 and 2 are those of every command for errors."""
DISAGREEMENTS = 10


def compare(
    a: Annotated[
        str,
        typer.Argument(help="Result of `bench task` or `sim` (folder or JSON), or a worker."),
    ],
    b: Annotated[str, typer.Argument(help="Another one.")],
    file: Annotated[
        Path | None, typer.Argument(help="A recording of both workers; they are compared in it.")
    ] = None,
    differ: Annotated[
        list[str] | None,
        typer.Option(
            "--differ",
            help=f"Condition of results that may differ, besides the model; repeatable: "
            f"{', '.join(CONDITIONS)}.",
        ),
    ] = None,
    tasks: Annotated[bool, typer.Option("--tasks", help="Of results: a row per task, too.")] = (
        False
    ),
    tolerance_s: Annotated[
        float,
        typer.Option(
            "--tolerance",
            help="In a recording: seconds between two observations of a pair.",
            min=0,
            max=3600,
        ),
    ] = DEFAULT_TOLERANCE_S,
    as_json: JsonOption = False,
) -> None:
    """Compare two results of `bench task` or `bench sim`, or the chunks of two workers.

    Results are compared on the layouts that both have: exits with 3 if B is worse than A (p below
    0.05), with 1 if they cannot be compared. In a recording, of which one worker may move the arm,
    chunks are paired by the time of their observation, and their motions compared from there.
    """
    if file is not None:
        if differ or tasks:
            raise typer.BadParameter("--differ and --tasks are of results: leave out the recording")
        _compare_workers(file, a, b, tolerance_s, as_json)
        return
    unknown = [name for name in differ or () if name not in CONDITIONS]
    if unknown:
        raise typer.BadParameter(f"--differ {unknown[0]!r}: {', '.join(CONDITIONS)}")
    first, second = (read_run(_bytes(Path(path)), path) for path in (a, b))
    found = compare_runs(first, second, differ or ())
    if as_json:
        print_json(found.to_dict())
    else:
        _print_runs(found, tasks=tasks)
    if found.b_is_worse:
        raise typer.Exit(B_IS_WORSE)


# -- results --------------------------------------------------------------------------------------
def _bytes(path: Path) -> bytes:
    try:
        return (path / "result.json" if path.is_dir() else path).read_bytes()
    except OSError as error:
        raise ResourceError(f"{path} cannot be read: {error.strerror}") from error


def _print_runs(found: Comparison, *, tasks: bool) -> None:
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


# -- workers --------------------------------------------------------------------------------------
def _compare_workers(file: Path, a: str, b: str, tolerance_s: float, as_json: bool) -> None:
    found = _compare(file, a, b, tolerance_s)
    if as_json:
        print_json({"a": a, "b": b, **{n: getattr(found, n) for n in found.__dataclass_fields__}})
    else:
        console().print(_table(a, b, found))
    if not found.pairs:
        fail(
            f"no chunks of {a} and {b} in {file} form a pair: {found.only_a} of {a}, "
            f"{found.only_b} of {b}"
        )
    if found.unreadable == found.pairs:
        fail(f"none of the {found.pairs} pairs can be compared: {found.why}")


def _compare(path: Path, a: str, b: str, tolerance_s: float) -> Disagreement:
    from vla_zenoh.lab.recording.run import load_run

    with progress(f"reading {path.name}"):
        run = load_run(path)
    chunks: dict[str, list[ActionChunk]] = {a: [], b: []}
    specs: dict[str, ModelSpec] = {}
    for entry in run.chunks:
        chunk: ActionChunk = entry.record
        spec = run.specs.get(chunk.spec_hash)
        if chunk.worker not in chunks or spec is None:
            continue
        # A worker that restarted may have another spec, which gives its steps another meaning.
        if specs.setdefault(chunk.worker, spec).hash == chunk.spec_hash:
            chunks[chunk.worker].append(chunk)
    for worker in (a, b):
        if worker not in specs:
            there = sorted({entry.record.worker for entry in run.chunks})
            fail(f"{path} has no chunks of {worker!r}; it has: {', '.join(there) or 'none'}")
    actions = [spec.action for spec in specs.values()]
    grips = any(action.gripper != "none" for action in actions)
    arm = make_kinematics(run.profile) if any(each.space == "joint" for each in actions) else None
    return disagreement(
        chunks[a],
        chunks[b],
        specs[a].action,
        specs[b].action,
        lambda stamp_ns: arm_state(run, stamp_ns, arm),
        max_width_m=run.profile.robot.max_width_m if grips else 0.0,
        tolerance_s=tolerance_s,
        arm=arm,
    )


def _table(a: str, b: str, found: Disagreement) -> Table:
    title = (
        f"{b} against {a}: {found.pairs} pairs, observations {found.apart_s * 1e3:.0f} ms apart, "
        f"motions compared after {found.after_s:.2f} s"
    )
    table = new_table("", "mean", "p95", "bias", title=title, left=("",))
    if found.mean is not None and found.p95 is not None and found.bias is not None:
        for axis, name in enumerate(AXES):
            unit, scale = ("mm", 1e3) if axis < 3 else ("mrad", 1e3)
            mean, p95, bias = (float(v[axis]) * scale for v in (found.mean, found.p95, found.bias))
            table.add_row(name, f"{mean:.2f} {unit}", f"{p95:.2f} {unit}", f"{bias:+.2f} {unit}")
    for name, value, form in (
        ("distance", found.distance_m, lambda v: f"{v * 1e3:.2f} mm"),
        ("angle", found.angle_rad, lambda v: f"{v * 1e3:.2f} mrad"),
        (f"cosine of directions ({found.moving} moving)", found.cosine, lambda v: f"{v:.3f}"),
        ("gripper differs", found.gripper, lambda v: f"{v:.0%}"),
    ):
        table.add_row(name, "" if value is None else form(value), "", "")
    alone = f"{found.only_a} of {a}, {found.only_b} of {b}"
    table.add_row("unpaired", alone, "", "")
    if found.unreadable:
        table.add_row("unreadable", str(found.unreadable), "", "")
    return table
