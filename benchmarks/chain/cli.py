"""python -m benchmarks chain."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import options
from vla_zenoh.cli.output import progress_bars
from vla_zenoh.lab.cli.bench_file import ResultOptions, write_json


@options
def chain(
    output: ResultOptions,
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
) -> None:
    """Measure picture to chunk and to pose command, beside other ways of serving a model.

    Every way carries the same picture of 640x480 and seven floats back; the model takes no time.
    All servers are processes on this computer, started and ended by turns.
    """
    from benchmarks.chain import report
    from benchmarks.chain.run import run
    from benchmarks.chain.ways import WAYS, ServingWay

    names = [way.name for way in WAYS]
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a way; there are: {', '.join(names)}")
    ways = [way for way in WAYS if not only or way.name in only]
    with output.open() as file, progress_bars(44) as bars:
        turns = rounds * sum(not way.missing() for way in ways)
        bar = bars.add_task("", total=turns)
        begun = 0

        def progress(way: ServingWay) -> None:
            nonlocal begun
            bars.update(bar, description=way.title, completed=begun)
            begun += 1

        result = run(ways, rounds, requests, progress)
        bars.update(bar, description="measured", completed=turns)
        write_json(file, result.to_dict())
    stages = report.stage_table(result)
    output.show(
        result.to_dict(),
        report.main_table(result),
        *([] if stages is None else [stages]),
        *(f"- {note}" for note in report.notes(result)),
    )
