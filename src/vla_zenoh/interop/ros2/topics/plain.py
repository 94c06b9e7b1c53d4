"""std_msgs/String, Float64 and Float64MultiArray, each with one field called data."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.types import JointCommand

TEXT, NUMBER = "std_msgs/msg/String", "std_msgs/msg/Float64"
NUMBERS = "std_msgs/msg/Float64MultiArray"
"""Taken by the position controllers of ros2_control."""


def read(message: Any) -> Any:
    """Value of the message."""
    return message.data


def write_position(messages: Messages, kind: str, position: float, stamp: Stamp) -> Any:
    """The opening of a gripper, as its driver takes it."""
    return messages.new(kind, data=np.array([position]) if kind == NUMBERS else position)


def write_joints(messages: Messages, kind: str, command: JointCommand, stamp: Stamp) -> Any:
    """Positions (rad), in the order of the profile's arm_joints."""
    return messages.new(kind, data=np.array(command.position_rad))
