"""vla-zenoh bench: measures this computer."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.bench_codec import codec
from vla_zenoh.cli.bench_command import command
from vla_zenoh.cli.bench_compare import compare
from vla_zenoh.cli.bench_file import JsonFileOption, write_json
from vla_zenoh.cli.bench_load import load
from vla_zenoh.cli.bench_motion import motion
from vla_zenoh.cli.bench_openvla import openvla
from vla_zenoh.cli.bench_task import task
from vla_zenoh.cli.output import console, errors

bench_app = typer.Typer(help="Measure this computer.", no_args_is_help=True)


bench_app.command("motion")(motion)
bench_app.command("load")(load)
bench_app.command("codec")(codec)
bench_app.command("command")(command)
bench_app.command("task")(task)
bench_app.command("compare")(compare)
bench_app.command("openvla")(openvla)


@bench_app.callback()
def _bench() -> None:
    pass


@bench_app.command("chain")
def chain(
    rounds: Annotated[
        int, typer.Option("--rounds", help="Turns that every way has.", min=1, max=100)
    ] = 5,
    requests: Annotated[
        int, typer.Option("--requests", help="Pictures in every turn.", min=1, max=10_000)
    ] = 100,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Measure this way alone; may be given more than once."),
    ] = None,
    json_file: JsonFileOption = None,
) -> None:
    """Measure picture to chunk and to pose command, beside other ways of serving a model.

    Every way carries the same picture of 640x480 and seven floats back; the model takes no time.
    All servers are processes on this computer, started and ended by turns.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from vla_zenoh.bench import report
    from vla_zenoh.bench.ways import WAYS, Way
    from vla_zenoh.nodes.bench.run import run

    names = [way.name for way in WAYS]
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a way; there are: {', '.join(names)}")
    ways = [way for way in WAYS if not only or way.name in only]
    with Progress(
        TextColumn("{task.description:<44}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=errors(),
    ) as bars:
        turns = rounds * sum(not way.missing() for way in ways)
        bar = bars.add_task("", total=turns)
        begun = 0

        def progress(way: Way) -> None:
            nonlocal begun
            bars.update(bar, description=way.title, completed=begun)
            begun += 1

        result = run(ways, rounds, requests, progress)
        bars.update(bar, description="measured", completed=turns)
    write_json(json_file, result.to_dict())
    out = console()
    out.print(report.main_table(result))
    stages = report.stage_table(result)
    if stages is not None:
        out.print(stages)
    for note in report.notes(result):
        out.print(f"- {note}")
