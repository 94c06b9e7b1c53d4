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
    """Drive an arm through the Python class that the profile names in `arm.file`."""
    from vla_zenoh.robots.node import RobotNode  # loads kinematics; other commands do not wait
    from vla_zenoh.robots.python_driver import PythonDriver

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: RobotNode(PythonDriver(loaded), session).run(stop),
        identity="arm",
        preferred=True,
    )
