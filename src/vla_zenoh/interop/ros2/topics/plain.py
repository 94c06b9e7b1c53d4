"""std_msgs/String and Float64: one field called data."""

from __future__ import annotations

from typing import Any

from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp

TEXT, NUMBER = "std_msgs/msg/String", "std_msgs/msg/Float64"


def read(message: Any) -> Any:
    """Value of the message."""
    return message.data


def write_position(messages: Messages, kind: str, position: float, stamp: Stamp) -> Any:
    """The opening of a gripper, as its driver takes it."""
    return messages.new(kind, data=position)
