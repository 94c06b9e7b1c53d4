"""Names of ROS 2 types, in source form and on the wire."""

from __future__ import annotations

import re

from vla_zenoh.errors import ProfileError

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")


def split_type(kind: str) -> tuple[str, str, str]:
    """``package/msg/Name`` in its three parts.

    Raises:
        ProfileError: it is no such name.
    """
    match = _TYPE.fullmatch(kind)
    if match is None:
        raise ProfileError(
            f"{kind[:80]!r} is not a ROS type: write package/msg/Name, package/srv/Name or "
            "package/action/Name"
        )
    return match[1], match[2], match[3]


def dds_type(kind: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, room, name = split_type(kind)
    return f"{package}::{room}::dds_::{name}_"


def request_of(service: str) -> str:
    """Type of a service's request."""
    return f"{service}_Request"


def response_of(service: str) -> str:
    """Type of a service's response."""
    return f"{service}_Response"


def send_goal_of(action: str) -> str:
    """The service that begins an action."""
    return f"{action}_SendGoal"


def get_result_of(action: str) -> str:
    """The service that waits for the end of an action."""
    return f"{action}_GetResult"
