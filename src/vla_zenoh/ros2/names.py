"""Names of ROS 2 types, in source form and on the wire, and of our own services and topics."""

from __future__ import annotations

import re
from typing import NamedTuple

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


class Service(NamedTuple):
    """A service of ours: the last part of its name, and its type."""

    name: str
    type: str


SET_ACTIVE = Service("set_active", "std_srvs/srv/SetBool")
STOP = Service("stop", "std_srvs/srv/Trigger")
RESET = Service("reset", "std_srvs/srv/Trigger")
SET_PROMPT = Service("set_prompt", "vla_msgs/srv/SetPrompt")
SET_REQUEST = Service("set_request", "vla_msgs/srv/SetRequest")
SERVICES = (SET_ACTIVE, STOP, RESET, SET_PROMPT, SET_REQUEST)

PROMPT_TOPIC, STATUS_TOPIC = "prompt", "status"
