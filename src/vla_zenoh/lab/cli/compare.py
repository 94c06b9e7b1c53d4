"""vla-zenoh lab compare: how far the chunks of two workers differ."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console, fail, new_table
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.evaluation.disagreement import (
    AXES,
    DEFAULT_TOLERANCE_S,
    Disagreement,
    arm_state,
    disagreement,
)
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk


def compare(
    a: Annotated[str, typer.Argument(help="One worker.")],
    b: Annotated[str, typer.Argument(help="The other one.")],
    file: Annotated[Path, typer.Argument(help="A recording of both.")],
    tolerance_s: Annotated[
        float,
        typer.Option(
            "--tolerance", help="Seconds between two observations of a pair.", min=0, max=3600
        ),
    ] = DEFAULT_TOLERANCE_S,
    as_json: JsonOption = False,
) -> None:
    """Show how far the chunks of two workers differ in a recording.

    One of them may move the arm. Chunks are paired by the time of their observation, and their
    motions compared from the arm's pose at that time.
    """
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
    grips = any(spec.action.gripper != "none" for spec in specs.values())
    return disagreement(
        chunks[a],
        chunks[b],
        specs[a].action,
        specs[b].action,
        lambda stamp_ns: arm_state(run, stamp_ns),
        max_width_m=run.profile.robot.gripper.max_width_m if grips else 0.0,
        tolerance_s=tolerance_s,
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
