"""vla-zenoh lab rolling, save, audit: the rolling record that `up` keeps."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import JsonOption, not_empty, options
from vla_zenoh.cli.output import console, errors, fail
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.cli.up import default_log_folder, rolling_folder
from vla_zenoh.errors import counted
from vla_zenoh.keys import ROLLING
from vla_zenoh.lab.cli.output import print_json
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
    """Keep the last minutes and the audit log, as `up` does beside the command node.

    At a stop, a fault, a rejected activation or `vla-zenoh lab save` the minutes are kept in a
    folder of their own. It runs at a low priority.
    """
    from vla_zenoh.lab.rolling.node import NICE, RingLimits, RollingRecord

    loaded = target.load()
    place = folder or rolling_folder(default_log_folder(), loaded)
    limits = RingLimits(keep_s=60 * minutes, max_bytes=megabytes * 1024 * 1024)
    with suppress(OSError):
        os.nice(NICE)

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
    with target.operator("lab", "save", why) as client:
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


def audit(
    folder: Annotated[Path, typer.Argument(help="Folder of a rolling record, or of a saved one.")],
    head: Annotated[
        str | None,
        typer.Option("--head", help="A hash that was noted elsewhere, and must be in the log."),
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Print every line of it.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check the chain of an audit log: an edited, removed or inserted line shows."""
    from vla_zenoh.lab.rolling.audit_log import verify_folder

    found = verify_folder(folder)
    missing = head is not None and not found.has(head)
    if as_json:
        print_json(
            asdict(found)
            | {
                "head_found": None if head is None else not missing,
                "entries": found.entries if show else None,
            }
        )
    else:
        authors = authors_of(found.entries)
        for entry in found.entries if show else ():
            console().print(one_line(told(entry, authors)), soft_wrap=True, markup=False)
        for gap in found.gaps:
            errors().print(one_line(f"gap: {gap}"), style="yellow", markup=False)
        for fault in found.faults:
            errors().print(one_line(f"FAULT: {fault}"), style="red", markup=False)
        since = f", from number {found.first}: older ones were deleted" if found.first else ""
        console().print(
            f"{counted(found.lines, 'line')}{since}; newest hash {found.head}", soft_wrap=True
        )
    if missing:
        fail(f"no line has the hash {head}: the log is another one, or its end was removed")
    if found.faults:
        fail(f"the chain is broken in {counted(len(found.faults), 'place')}")


def authors_of(entries: list[dict]) -> dict[str, str]:
    """Session number -> certificate and address, as the routers said."""
    out: dict[str, str] = {}
    for entry in entries:
        facts = entry["facts"]
        if entry["what"] == "client":
            who = facts.get("certificate") or "no certificate"
            out[str(facts.get("client"))] = f"{who} at {facts.get('address')}"
    return out


def told(entry: dict, authors: dict[str, str]) -> str:
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(entry["wall_ns"] / 1e9))
    facts = dict(entry["facts"])
    by = ""
    if entry["what"] == "put":
        client = str(facts.pop("client", ""))
        by = f", by {authors.get(client, client or 'a client that does not say who it is')}"
    words = " ".join(f"{name}={value!r}" for name, value in facts.items())
    return f"{entry['number']} {at} {entry['what']} {words}{by}"
