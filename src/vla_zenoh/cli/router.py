"""vla-zenoh router."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    AlsoOption,
    HostOption,
    ListenOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.runtime.parent_watch import RUN_FOLDER_VARIABLE
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
from vla_zenoh.runtime.router import router_config, run_router, run_zenohd
from vla_zenoh.runtime.scheduling import prefer_this_process, realtime_links


def router(
    profile: ProfileOption = DEFAULT_PROFILE,
    listen: ListenOption = None,
    host: HostOption = None,
    also: AlsoOption = None,
    show_config: Annotated[
        bool, typer.Option("--config", help="Print Zenoh's configuration of it, and end.")
    ] = False,
) -> None:
    """Run the Zenoh router that all nodes of a lab meet at."""
    loaded = effective_profile(profile, listen=listen, host=host)
    others = [effective_profile(name) for name in also or ()]
    if show_config:
        print(json.dumps(router_config(loaded, host=host, also=others), indent=2))
        return
    die_with_parent()
    prefer_this_process()
    with realtime_links():
        if loaded.session.router == "zenohd":
            given = os.environ.get(RUN_FOLDER_VARIABLE)
            folder = Path(given) if given else Path(tempfile.mkdtemp(prefix="vla-zenoh-"))
            run_zenohd(loaded, folder, host=host, also=others)
        stop = stop_on_signals()
        print(f"routing, {loaded.name}", flush=True)
        run_router(loaded, stop, host=host, also=others)
