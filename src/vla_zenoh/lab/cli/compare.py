"""vla-zenoh lab compare: how far the chunks of two workers differ."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, fail, new_table, print_json, progress
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.lab.compare.agreement import (
    AXES,
    DEFAULT_TOLERANCE_S,
    ArmStateHistory,
    Disagreement,
)
from vla_zenoh.lab.compare.agreement import compare as disagreement
from vla_zenoh.lab.compare.listener import CompareListener
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk

POLL_S, REFRESH_S = 0.05, 1.0


@options
def compare(
    a: Annotated[str, typer.Argument(help="One worker.")],
    b: Annotated[str, typer.Argument(help="The other one.")],
    target: RobotTarget,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", help="How long to listen.", min=0.1)
    ] = 10.0,
    recording: Annotated[
        Path | None, typer.Option("--recording", "-r", help="Compare in this recording.")
    ] = None,
    tolerance_s: Annotated[
        float,
        typer.Option("--tolerance", help="Seconds between two observations of a pair.", min=0),
    ] = DEFAULT_TOLERANCE_S,
    as_json: JsonOption = False,
) -> None:
    """Show how far the chunks of two workers differ, live or in a recording.

    One of them may move the arm. Chunks are paired by the time of their observation, and their
    motions compared from the arm's pose at that time.
    """
    loaded = target.load()
    if recording is not None:
        found = _recorded(recording, loaded, a, b, tolerance_s)
    else:
        found = _live(loaded, a, b, seconds, tolerance_s, show=not as_json)
    if as_json:
        print_json({"a": a, "b": b, **{n: getattr(found, n) for n in found.__dataclass_fields__}})
    else:
        console().print(_table(a, b, found))
    if not found.pairs:
        fail(
            f"no chunks of {a} and {b} form a pair: {found.only_a} of {a}, {found.only_b} of "
            f"{b}; do both run? (`vla-zenoh status`)"
        )


def _live(
    profile: Profile, a: str, b: str, seconds: float, tolerance_s: float, *, show: bool
) -> Disagreement:
    with open_session(profile.session) as session:
        listener = CompareListener(session, profile.keys, (a, b))
        end_s, shown_s = time.monotonic() + seconds, 0.0
        live = show and console().is_terminal
        with (
            Live(console=console(), auto_refresh=False, transient=True)
            if live
            else nullcontext() as screen
        ):
            while time.monotonic() < end_s:
                time.sleep(POLL_S)
                listener.poll()
                if screen is not None and time.monotonic() - shown_s > REFRESH_S:
                    shown_s = time.monotonic()
                    now = _of(
                        profile,
                        listener.chunks,
                        listener.specs,
                        listener.standing,
                        a,
                        b,
                        tolerance_s,
                    )
                    screen.update(_table(a, b, now), refresh=True)
        listener.close()
    return _of(profile, listener.chunks, listener.specs, listener.standing, a, b, tolerance_s)


def _recorded(path: Path, profile: Profile, a: str, b: str, tolerance_s: float) -> Disagreement:
    from vla_zenoh.lab.recording.run import load_run

    with progress(f"reading {path.name}"):
        run = load_run(path)
    chunks: dict[str, list[ActionChunk]] = {a: [], b: []}
    specs: dict[str, ModelSpec] = {}
    for heard in run.chunks:
        chunk: ActionChunk = heard.record
        spec = run.specs.get(chunk.spec_hash)
        if chunk.worker in chunks and spec is not None:
            specs.setdefault(chunk.worker, spec)
            if chunk.spec_hash == specs[chunk.worker].hash:
                chunks[chunk.worker].append(chunk)
    for worker in (a, b):
        if worker not in specs:
            there = sorted({heard.record.worker for heard in run.chunks})
            fail(f"{path} has no chunks of {worker!r}; it has: {', '.join(there) or 'none'}")
    standing = ArmStateHistory()
    for heard in (*run.poses, *run.grippers):
        standing.add(heard.header.stamp_wall_ns, heard.record)
    return _of(profile, chunks, specs, standing, a, b, tolerance_s)


def _of(
    profile: Profile,
    chunks: dict[str, list[ActionChunk]],
    specs: dict[str, ModelSpec],
    standing: ArmStateHistory,
    a: str,
    b: str,
    tolerance_s: float,
) -> Disagreement:
    try:
        return disagreement(
            chunks[a],
            chunks[b],
            specs[a].action,
            specs[b].action,
            standing.at,
            max_width_m=profile.robot.gripper.max_width_m,
            tolerance_s=tolerance_s,
        )
    except VlaZenohError as error:
        fail(str(error))


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
