"""vla-zenoh up."""

from __future__ import annotations

import datetime as dt
import threading
import zlib
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    PROFILE_VARIABLE,
    AlsoOption,
    ConnectOption,
    HostOption,
    ListenOption,
    effective_profile,
)
from vla_zenoh.cli.output import console, styled
from vla_zenoh.errors import MissingExtraError
from vla_zenoh.nodes.launch import Host
from vla_zenoh.nodes.process import die_with_parent, stop_on_signals
from vla_zenoh.profile import Profile
from vla_zenoh.security.store import Store

COLOURS = ("cyan", "magenta", "green", "yellow", "blue", "bright_cyan", "bright_magenta")


def up(
    profile: Annotated[
        str, typer.Argument(envvar=PROFILE_VARIABLE, help="Name or path of a profile.")
    ] = DEFAULT_PROFILE,
    host: HostOption = None,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    also: AlsoOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Compute and check everything, command nothing.")
    ] = False,
) -> None:
    """Start and supervise all nodes that belong on this host. Ctrl-C brakes the arm first."""
    stop = stop_on_signals()
    die_with_parent()
    loaded = effective_profile(profile, connect, listen)
    out = console()
    lock = threading.Lock()

    def log(node: str, line: str, style: str = "") -> None:
        name = styled(f"{node:>16}", COLOURS[zlib.crc32(node.encode()) % len(COLOURS)])
        with lock:
            out.print(name, styled(line, style), sep=" | ", soft_wrap=True)

    def tell(node: str, sentence: str) -> None:
        log(node, sentence, "bold")

    others = [effective_profile(name, host=host) for name in also or ()]
    with Host(loaded, host, log=log, tell=tell, also=others, dry_run=dry_run) as running:
        where = ", ".join(running.profile.session.connect)
        tell("up", f"profile {loaded.name}, host {running.host}, router at {where}")
        if dry_run:
            tell("up", "dry run: the robot is commanded nothing")
        for sentence in _soon(running.profile, running.host):
            tell("up", sentence)
        tell("up", "look: vla-zenoh status; drive: vla-zenoh prompt/activate; end: Ctrl-C")
        running.serve(stop)
        tell("up", "braking the arm, then ending every node")
    tell("up", "all nodes have ended")


def _soon(profile: Profile, host: str) -> list[str]:
    """What is to be done soon about the certificates of this host."""
    if profile.session.security is None:
        return []
    try:
        entries = Store(profile.session.security.folder).entries(dt.datetime.now(dt.UTC), host)
    except MissingExtraError:
        return []  # a host that only uses certificates need not be able to read them
    return [f"certificate {entry.path} {entry.warning}" for entry in entries if entry.warning]
