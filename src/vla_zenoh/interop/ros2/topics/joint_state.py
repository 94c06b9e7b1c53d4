"""sensor_msgs/JointState."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2.samples import Joints
from vla_zenoh.interop.ros2.stamps import to_ns
from vla_zenoh.types import MAX_NAMES, FloatArray

TYPE = "sensor_msgs/msg/JointState"


def read(message: Any) -> Joints:
    """Joints of a message; velocities and efforts may be missing, positions may not.

    Raises:
        CodecError: lists that do not fit each other.
    """
    names = tuple(message.name)
    if not 0 < len(names) <= MAX_NAMES or len(set(names)) != len(names):
        raise CodecError("invalid", f"{len(names)} joint names, or one of them twice")
    position = _values("position", message.position, len(names))
    if position is None:
        raise CodecError("invalid", "joints without positions")
    return Joints(
        to_ns(message.header.stamp),
        names,
        position,
        _values("velocity", message.velocity, len(names)),
        _values("effort", message.effort, len(names)),
    )


def _values(what: str, given: Any, count: int) -> FloatArray | None:
    if len(given) == 0:
        return None
    if len(given) != count:
        raise CodecError("invalid", f"{len(given)} numbers of {what} for {count} joints")
    return np.asarray(given, np.float64)
