"""Any message with a pose in it: PoseStamped, CartesianImpedanceGoal, and those of your own.

A message is filled by what its fields are. ``geometry_msgs/Pose`` (or ``PoseStamped``) gets the
pose, ``std_msgs/Header`` stamp and frame, ``geometry_msgs/Twist`` the feed-forward velocity, and an
array of as many numbers as the arm has joints the posture of its nullspace. The rest stays zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from vla_zenoh.errors import ProfileError
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.interop.ros2.topics import header
from vla_zenoh.types import FloatArray, PoseCommand

POSE, STAMPED = "geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped"
_HEADER, _TWIST = "std_msgs/msg/Header", "geometry_msgs/msg/Twist"


def check(messages: Messages, kind: str) -> None:
    """Make sure that a pose can be sent as `kind`.

    Raises:
        ProfileError: it has no field for a pose.
    """
    messages.require(kind)
    named = [what for node, what in messages.fields(kind).values() if node == Nodetype.NAME]
    if kind != POSE and not {POSE, STAMPED} & set(named):
        raise ProfileError(f"{kind} has no field of type {POSE} or {STAMPED} to put a pose into")


def writer(posture_rad: FloatArray) -> Any:
    """A way to write poses; `posture_rad` (n,) is what the nullspace prefers."""

    def write(messages: Messages, kind: str, command: PoseCommand, stamp: Stamp) -> Any:
        if kind == POSE:
            return _pose(messages, command)
        values = {
            name: value
            for name, described in messages.fields(kind).items()
            if (value := _fill(messages, described, command, stamp, posture_rad)) is not None
        }
        return messages.new(kind, **values)

    return write


def _fill(
    messages: Messages, described: Any, command: PoseCommand, stamp: Stamp, posture: FloatArray
) -> Any:
    node, what = described
    if node == Nodetype.ARRAY:
        (inner, of), size = what
        is_posture = inner == Nodetype.BASE and of[0] == "float64" and size == len(posture)
        return np.array(posture) if is_posture else None
    if node != Nodetype.NAME:
        return None
    if what == _HEADER:
        return header.write(messages, stamp)
    if what == POSE:
        return _pose(messages, command)
    if what == STAMPED:
        return messages.new(
            STAMPED, header=header.write(messages, stamp), pose=_pose(messages, command)
        )
    return _twist(messages, command) if what == _TWIST else None


def _pose(messages: Messages, command: PoseCommand) -> Any:
    x, y, z = command.position_m.tolist()
    qx, qy, qz, qw = command.quat_xyzw.tolist()
    return messages.new(
        POSE,
        position=messages.new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=messages.new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def _twist(messages: Messages, command: PoseCommand) -> Any:
    linear, angular = command.twist[:3].tolist(), command.twist[3:].tolist()
    return messages.new(
        _TWIST,
        linear=messages.new("geometry_msgs/msg/Vector3", **dict(zip("xyz", linear, strict=True))),
        angular=messages.new("geometry_msgs/msg/Vector3", **dict(zip("xyz", angular, strict=True))),
    )
