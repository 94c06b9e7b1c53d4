"""Our ROS 2 services and topics, which mirror the setting keys."""

from __future__ import annotations

from typing import NamedTuple


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
