"""std_msgs/Float64MultiArray: what position controllers of ros2_control take."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.types import JointCommand

TYPE = "std_msgs/msg/Float64MultiArray"


def write_joints(messages: Messages, kind: str, command: JointCommand, stamp: Stamp) -> Any:
    """Positions (rad), in the order of the profile's arm_joints."""
    return messages.new(kind, data=np.array(command.position_rad))


def write_position(messages: Messages, kind: str, position: float, stamp: Stamp) -> Any:
    """The opening of a gripper, as its driver takes it, alone."""
    return messages.new(kind, data=np.array([position]))
