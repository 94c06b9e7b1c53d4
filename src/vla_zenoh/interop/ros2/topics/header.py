"""std_msgs/Header."""

from __future__ import annotations

from typing import Any

from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.interop.ros2.stamps import from_ns


def write(messages: Messages, stamp: Stamp) -> Any:
    """A header with this stamp and frame."""
    time = messages.new("builtin_interfaces/msg/Time", **from_ns(stamp.stamp_ns))
    return messages.new("std_msgs/msg/Header", stamp=time, frame_id=stamp.frame)
