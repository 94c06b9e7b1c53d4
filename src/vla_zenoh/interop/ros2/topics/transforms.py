"""tf2_msgs/TFMessage."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.interop.ros2.samples import Transform
from vla_zenoh.interop.ros2.stamps import to_ns

TYPE = "tf2_msgs/msg/TFMessage"


def read(message: Any) -> tuple[Transform, ...]:
    """All transforms of a message.

    Raises:
        CodecError: a stamp that is none.
    """
    return tuple(
        Transform(
            to_ns(entry.header.stamp),
            entry.header.frame_id.lstrip("/"),
            entry.child_frame_id.lstrip("/"),
            np.array([shift.x, shift.y, shift.z]),
            np.array([turn.x, turn.y, turn.z, turn.w]),
        )
        for entry in message.transforms
        for shift, turn in [(entry.transform.translation, entry.transform.rotation)]
    )
