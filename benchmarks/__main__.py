"""``python -m benchmarks``, in a checkout: compares vla-zenoh with other policy servers."""

from __future__ import annotations

import sys

import typer

from benchmarks.arms import arms
from benchmarks.chain.cli import chain
from benchmarks.codec.cli import codec
from benchmarks.delay import delay
from benchmarks.deployment import deployment
from benchmarks.depth import depth
from benchmarks.flywheel.cli import flywheel
from benchmarks.footprint import footprint
from benchmarks.load.cli import load
from benchmarks.load.serving import serving
from benchmarks.motion.cli import motion
from benchmarks.openvla import openvla
from benchmarks.readers import readers
from benchmarks.rest import rest
from benchmarks.stop import stop
from benchmarks.thesis.cli import thesis
from benchmarks.web import web
from vla_zenoh.cli.output import complain
from vla_zenoh.errors import VlaZenohError

app = typer.Typer(
    help="Compare vla-zenoh with other ways of serving a policy.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
COMMANDS = (
    arms,
    chain,
    codec,
    delay,
    deployment,
    depth,
    flywheel,
    footprint,
    load,
    motion,
    openvla,
    readers,
    rest,
    serving,
    stop,
    thesis,
    web,
)
for command in COMMANDS:
    app.command()(command)

if __name__ == "__main__":
    try:
        app()
    except VlaZenohError as error:
        complain(str(error))
        sys.exit(1)
