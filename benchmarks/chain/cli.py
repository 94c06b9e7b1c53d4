"""python -m benchmarks chain."""

from __future__ import annotations

from typing import Annotated

import typer
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from vla_zenoh.cli.options import options
from vla_zenoh.lab.cli.output import progress_bars


@options
def chain(
    output: ResultOptions,
    rounds: Annotated[
        int, typer.Option("--rounds", help="Rounds for every way.", min=1, max=100)
    ] = 5,
    requests: Annotated[
        int, typer.Option("--requests", help="Images in every round.", min=1, max=10_000)
    ] = 100,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Measure only this way; may be given more than once."),
    ] = None,
    size: Annotated[
        str, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Of an image.")
    ] = "640x480",
    cameras: Annotated[
        int, typer.Option("--cameras", help="Images in a request.", min=1, max=3)
    ] = 1,
    pause: Annotated[
        bool, typer.Option("--pause/--no-pause", help="12 to 20 ms from request to request.")
    ] = True,
) -> None:
    """Measure image to chunk and to pose command, compared with other ways of serving a model.

    Every way carries the same images there and seven floats back; the model takes no time.
    All servers are processes on this computer, started and stopped in turn.
    """
    from benchmarks.chain import report
    from benchmarks.chain.run import run
    from benchmarks.chain.ways import WAYS, Load, ServingWay

    names = [way.name for way in WAYS]
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a way; there are: {', '.join(names)}")
    sides = size.split("x")
    if len(sides) != 2 or not all(s.isdecimal() and 16 <= int(s) <= 4096 for s in sides):
        raise typer.BadParameter(f"--size {size!r} is not WIDTHxHEIGHT, 16 to 4096 pixels each")
    load = Load(requests, (int(sides[0]), int(sides[1])), cameras, pause)
    ways = [way for way in WAYS if not only or way.name in only]
    with output.open() as file, progress_bars(44) as bars:
        turns = rounds * sum(not way.missing() for way in ways)
        bar = bars.add_task("", total=turns)
        begun = 0

        def progress(way: ServingWay) -> None:
            nonlocal begun
            bars.update(bar, description=way.title, completed=begun)
            begun += 1

        result = run(ways, rounds, load, progress)
        bars.update(bar, description="measured", completed=turns)
        write_json(file, result.to_dict())
    stages = report.stage_table(result)
    output.show(
        result.to_dict(),
        report.main_table(result),
        *([] if stages is None else [stages]),
        *(f"- {note}" for note in report.notes(result)),
    )
