"""Declaration of the robot driver ``ros2``; see `vla_zenoh.plugins`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from vla_zenoh.errors import ProfileError
from vla_zenoh.plugins import Fault, RobotPlugin
from vla_zenoh.profile import Profile
from vla_zenoh_ros2.contradictions import contradictions


def _check(profile: Profile, options: Any) -> Iterator[Fault]:
    """Faults of the messages that the profile names."""
    from vla_zenoh_ros2.driver import Ros2Driver

    try:
        Ros2Driver(profile)
    except ProfileError as error:
        yield ("ros2",), str(error)


def _check_host(profile: Profile, options: Any) -> Iterator[Any]:
    from vla_zenoh_ros2.check import ros2_bridge

    return ros2_bridge(profile)


PLUGIN = RobotPlugin(contradictions=contradictions, check=_check, check_host=_check_host)
