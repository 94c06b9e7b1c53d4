"""vla-zenoh command."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.runtime.parent_watch import RUN_FOLDER_VARIABLE
from vla_zenoh.runtime.process import run_node


def command(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Compute and check everything, command nothing.")
    ] = False,
) -> None:
    """Run the command node: turns chunks into a bounded, smooth pose stream."""
    from vla_zenoh.nodes.command.node import CommandNode

    loaded = effective_profile(profile, connect)
    folder = os.environ.get(RUN_FOLDER_VARIABLE)
    latch = Path(folder) / "stopped" if folder else None
    run_node(
        loaded,
        lambda session, stop: CommandNode(loaded, session, dry_run=dry_run, latch=latch).run(stop),
        identity="command",
        preferred=True,
    )
