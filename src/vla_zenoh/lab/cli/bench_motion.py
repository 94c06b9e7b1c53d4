"""vla-zenoh bench motion."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from vla_zenoh.cli.options import DEFAULT_PROFILE, effective_profile, number_list
from vla_zenoh.cli.output import console, errors
from vla_zenoh.lab.bench.motion import PROTOCOL, STEPS, Conditions, MotionCase
from vla_zenoh.lab.cli.bench_file import JsonFileOption, up_with_last_lines, write_json
from vla_zenoh.profile import Profile

WIDTH = 124
Rows = list[dict[str, Any]]


def motion(
    rates: Annotated[str, typer.Option("--rates", help="Hz, separated by commas.")] = "1,2,5,10",
    prompts: Annotated[
        str, typer.Option("--prompts", help="'all', or motions separated by commas.")
    ] = "all",
    chunks: Annotated[
        str, typer.Option("--chunks", help="Steps in a chunk, separated by commas: 1,8,50.")
    ] = "1",
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, max=2000, help="Inference time in ms.")
    ] = 0.0,
    jitter: Annotated[
        float, typer.Option("--jitter", min=0, max=0.9, help="Share by which it varies.")
    ] = 0.0,
    lockstep: Annotated[
        bool,
        typer.Option("--lockstep", help="On a virtual clock, faster than real time, no nodes."),
    ] = False,
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
    ] = DEFAULT_PROFILE,
    json_file: JsonFileOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for a plot of every row.")
    ] = None,
) -> None:
    """Run the thesis's ten prompts, 50 steps each, through the real chain, and judge each.

    Exits with 0 only when every row keeps its promises.
    """
    from vla_zenoh.lab.bench.motion_report import motion_table, thesis_table
    from vla_zenoh.runtime.process import stop_on_signals

    if lockstep and out is not None:
        raise typer.BadParameter("--out draws what real nodes did: leave out --lockstep")
    horizons = [int(part) for part in number_list("--chunks", chunks, 1, 100)]
    conditions = [
        Conditions(rate_hz, horizon, delay_ms, jitter)
        for horizon in horizons
        for rate_hz in number_list("--rates", rates, 0.2, 50)
    ]
    stop = stop_on_signals()
    loaded = effective_profile(profile)
    rows: Rows = []
    try:
        with Progress(
            TextColumn("{task.description:<44}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=errors(),
        ) as bars:
            run = _lockstep if lockstep else _real_time
            run(loaded, _trials(prompts), conditions, stop, bars, rows, out)
    finally:
        write_json(json_file, rows)
    beside = thesis_table(rows, virtual=lockstep)
    screen = console(WIDTH)
    screen.print(motion_table(rows))
    if beside.row_count:
        screen.print(beside)
    if stop.is_set():
        raise typer.Exit(130)
    if not rows or not all(row["ok"] for row in rows):
        raise typer.Exit(1)


def _lockstep(
    profile: Profile,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    bars: Progress,
    rows: Rows,
    out: Path | None,
) -> None:
    from vla_zenoh.lab.bench.motion_lockstep import run_in_lockstep

    bar = bars.add_task("all rows", total=len(trials) * len(conditions))
    done: Callable[[Any], None] = lambda _: bars.update(bar, advance=1)  # noqa: E731
    rows += run_in_lockstep(profile, trials, conditions, stop, done)


def _real_time(
    profile: Profile,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    bars: Progress,
    rows: Rows,
    out: Path | None,
) -> None:
    from vla_zenoh.cli.free_endpoint import own_address
    from vla_zenoh.lab.episode import Interrupted
    from vla_zenoh.runtime.process import die_with_parent

    die_with_parent()
    loaded = own_address(profile)
    everything = bars.add_task("all rows", total=len(trials) * len(conditions))
    current = bars.add_task("starting the nodes", total=STEPS)
    # A worker is what it is from its start on: one start for each kind of chunk.
    for horizon in dict.fromkeys(each.horizon for each in conditions):
        alike = [each for each in conditions if each.horizon == horizon]
        try:
            _with_one_worker(loaded, trials, alike, stop, bars, (everything, current), rows, out)
        except Interrupted:
            return


def _with_one_worker(
    profile: Profile,
    trials: Sequence[MotionCase],
    conditions: Sequence[Conditions],
    stop: threading.Event,
    bars: Progress,
    tasks: tuple[TaskID, TaskID],
    rows: Rows,
    out: Path | None,
) -> None:
    from vla_zenoh.lab.bench.motion_runner import run_in_real_time
    from vla_zenoh.lab.demo.plot import plot_run
    from vla_zenoh.runtime.launch import Host

    everything, current = tasks
    lines: list[str] = []

    def progress(trial: MotionCase, each: Conditions, done: int) -> None:
        bars.update(current, description=f"{trial.name} at {each.name}", completed=done)

    def log(node: str, line: str) -> None:
        lines.append(f"{node:>16} | {line}")

    first = conditions[0]
    options = (
        f"horizon={first.horizon}",
        f"delay_ms={first.delay_ms:g}",
        f"jitter={first.jitter:g}",
    )
    host = Host(
        profile,
        None,
        log=log,
        tell=log,
        own_router=True,
        worker_options={profile.task.worker: options},
    )
    with up_with_last_lines(host, lines) as running:
        for row, recording in run_in_real_time(running, trials, conditions, stop, progress):
            rows.append(row)
            bars.update(everything, advance=1)
            if out is not None:
                out.mkdir(parents=True, exist_ok=True)
                name = f"{row['prompt']}_{row['rate_hz']:g}Hz_{row['horizon']}.png"
                plot_run(
                    out / name.replace(" ", "_"),
                    profile,
                    recording.poses,
                    recording.commands,
                    recording.marks,
                    [],
                )


def _trials(prompts: str) -> list[MotionCase]:
    names = [trial.name for trial in PROTOCOL]
    wanted = names if prompts == "all" else [part.strip() for part in prompts.split(",")]
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a motion; there are: {', '.join(names)}")
    return [trial for trial in PROTOCOL if trial.name in wanted]
