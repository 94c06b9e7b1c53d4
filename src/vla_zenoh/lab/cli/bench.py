"""vla-zenoh bench: measures the chain, and judges models by task."""

from __future__ import annotations

import typer

from vla_zenoh.lab.cli.bench_command import command
from vla_zenoh.lab.cli.bench_compare import compare
from vla_zenoh.lab.cli.bench_motion import motion
from vla_zenoh.lab.cli.bench_task import task

bench_app = typer.Typer(help="Measure this computer.", no_args_is_help=True)


bench_app.command("motion")(motion)
bench_app.command("command")(command)
bench_app.command("task")(task)
bench_app.command("compare")(compare)


@bench_app.callback()
def _bench() -> None:
    pass
