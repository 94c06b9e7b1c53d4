"""vla-zenoh node rolling, save: the rolling record that `up` keeps."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import not_empty, options
from vla_zenoh.cli.output import console, fail
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.cli.up import default_log_folder, rolling_folder
from vla_zenoh.keys import ROLLING
from vla_zenoh.runtime.process import run_node
from vla_zenoh.sanitize import one_line

SAVED_S = 20.0
HEARD_S = 3.0


@options
def rolling(
    target: RobotTarget,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", help="Of the record. Default: where `up` keeps its own."),
    ] = None,
    minutes: Annotated[
        float, typer.Option("--minutes", help="How much is kept.", min=0.1, max=1440)
    ] = 10.0,
    megabytes: Annotated[
        int, typer.Option("--megabytes", help="Room on the disk at most.", min=20, max=10**9)
    ] = 2048,
) -> None:
    """Keep the last minutes and a log of settings, as `up` does beside the command node.

    At a stop, a fault, a rejected activation or `vla-zenoh save` the minutes are kept in a
    folder of their own. It runs at a low priority.
    """
    from vla_zenoh_rolling.node import RingLimits, RollingRecord

    loaded = target.load()
    place = folder or rolling_folder(default_log_folder(), loaded)
    limits = RingLimits(keep_s=60 * minutes, max_bytes=megabytes * 1024 * 1024)

    def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
        RollingRecord(loaded, session, place, limits).run(stop)

    run_node(loaded, run, identity=None)


@options
def save(
    target: RobotTarget,
    why: Annotated[
        str, typer.Argument(parser=not_empty, help="Why; it is kept with the record.")
    ] = "by hand",
) -> None:
    """Keep the last minutes of the rolling record, which `up` keeps, in a folder of their own."""
    with target.operator("save", why) as client:
        if not client.wait_for(lambda: ROLLING in client.alive, HEARD_S):
            fail("no rolling record runs; `vla-zenoh up` keeps one beside the command node")
        client.publish(client.keys.save, why)
        give_up_s = time.monotonic() + SAVED_S
        while time.monotonic() < give_up_s:
            for node, _, event in client.pop_events():
                if node == ROLLING and event.what == "saved":
                    console().print(one_line(event.why), soft_wrap=True)
                    return
                if node == ROLLING and event.what == "not_saved":
                    fail(one_line(event.why))
            time.sleep(0.05)
        fail(f"it was not saved within {SAVED_S:g} s; `vla-zenoh status` shows the node {ROLLING}")
