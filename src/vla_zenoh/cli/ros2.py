"""vla-zenoh ros2."""

from __future__ import annotations

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.nodes.process import run_node


def ros2(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Drive a ROS 2 robot and serve its cameras, through a bridge or rmw_zenoh."""
    from vla_zenoh.nodes.ros2.node import Ros2Node  # loads kinematics; other commands do not wait

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: Ros2Node(loaded, session).run(stop),
        identity="ros2",
        preferred=True,
    )
