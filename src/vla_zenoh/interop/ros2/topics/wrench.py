"""geometry_msgs/WrenchStamped."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.interop.ros2.samples import Wrench
from vla_zenoh.interop.ros2.stamps import to_ns

TYPE = "geometry_msgs/msg/WrenchStamped"


def read(message: Any) -> Wrench:
    """Force and torque.

    Raises:
        CodecError: a stamp that is none.
    """
    force, torque = message.wrench.force, message.wrench.torque
    return Wrench(
        to_ns(message.header.stamp),
        message.header.frame_id,
        np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z]),
    )
