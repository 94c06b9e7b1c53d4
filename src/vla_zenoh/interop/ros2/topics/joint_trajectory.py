"""trajectory_msgs/JointTrajectory: one point, to be reached when the next one is due."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.interop.ros2.stamps import from_ns
from vla_zenoh.interop.ros2.topics import header
from vla_zenoh.types import JointCommand

TYPE = "trajectory_msgs/msg/JointTrajectory"
NOW = 0
"""A stamp of zero means: from now on, whatever the robot's clock says."""


def writer(lead_ns: int) -> Any:
    """A way to write commands whose point is `lead_ns` ahead."""

    def write(messages: Messages, kind: str, command: JointCommand, stamp: Stamp) -> Any:
        point = messages.new(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array(command.position_rad),
            velocities=np.array(command.velocity_rad_s),
            accelerations=np.array(command.acceleration_rad_s2),
            time_from_start=messages.new("builtin_interfaces/msg/Duration", **from_ns(lead_ns)),
        )
        return messages.new(
            kind,
            header=header.write(messages, Stamp(NOW, stamp.frame)),
            joint_names=list(command.names),
            points=[point],
        )

    return write
