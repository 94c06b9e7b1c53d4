"""vla-zenoh arm."""

from __future__ import annotations

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.runtime.process import run_node


def arm(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Drive an arm by the Python file that the profile names in `arm.file`."""
    from vla_zenoh.robots.python.node import ArmNode  # loads kinematics; other commands do not wait

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: ArmNode(loaded, session).run(stop),
        identity="arm",
        preferred=True,
    )
