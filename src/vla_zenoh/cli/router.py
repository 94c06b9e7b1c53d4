"""vla-zenoh router."""

from __future__ import annotations

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ListenOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.nodes.process import die_with_parent, stop_on_signals
from vla_zenoh.nodes.router import run_router


def router(profile: ProfileOption = DEFAULT_PROFILE, listen: ListenOption = None) -> None:
    """Run the Zenoh router that all nodes of a lab meet at."""
    stop = stop_on_signals()
    die_with_parent()
    loaded = effective_profile(profile, listen=listen)
    print(f"routing on {', '.join(loaded.session.listen)}", flush=True)
    run_router(loaded, stop)
