"""vla-zenoh sim."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.runtime.process import run_node


def sim(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    lockstep: Annotated[
        bool,
        typer.Option(
            "--lockstep", help="Time stands still until somebody queries the key sim/step."
        ),
    ] = False,
) -> None:
    """Run the simulated robot: takes command keys, gives state keys."""
    from vla_zenoh.robots.sim.node import (
        SimNode,  # MuJoCo takes a while; other commands need not wait
    )

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: SimNode(loaded, session, lockstep=lockstep).run(stop),
        identity="sim",
        preferred=True,
    )
