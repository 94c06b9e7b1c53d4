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
            "--lockstep", help="Simulated time advances only by queries on the key sim/step."
        ),
    ] = False,
) -> None:
    """Run the simulated robot: subscribes to command keys, publishes state keys."""
    from vla_zenoh.robots.node import RobotNode  # MuJoCo loads slowly; other commands must not wait
    from vla_zenoh.robots.sim_driver import SimDriver

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: RobotNode(SimDriver(loaded, lockstep=lockstep), session).run(stop),
        identity="sim",
        preferred=True,
    )
