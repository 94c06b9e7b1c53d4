"""Standard ROS 2 messages of a recording, in CDR by rosbags, so that any viewer draws them.

All channels have standard types in one serialization: ``ros2 bag play`` of Humble to Kilted rejects
a file that mixes CDR with, for example, MCAP's JSON (https://github.com/ros2/rosbag2/issues/1245),
and cannot play a type whose package is not installed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from vla_zenoh.errors import CodecError, MissingExtraError
from vla_zenoh.types import JointCommand, JointState, ObjectPoses, PoseCommand, PoseState

if TYPE_CHECKING:
    from vla_zenoh.codec.cdr import CdrMessages

IMAGE, JPEG_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
POSE, POSES = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseArray"
JOINTS, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
LAST_SECOND = 2**31
MAX_MESSAGE_BYTES = 256 * 1024 * 1024


@cache
def messages() -> CdrMessages:
    """The message types of ROS 2. Raises MissingExtraError: rosbags is not installed."""
    try:
        from rosbags.typesys import Stores, get_typestore

        from vla_zenoh.codec.cdr import CdrMessages
    except ImportError as error:
        raise MissingExtraError("rosbags", "record") from error
    # Later distributions have the same standard messages.
    return CdrMessages(get_typestore(Stores.ROS2_HUMBLE))


def schema_text(name: str) -> bytes:
    """Definition of a message and of its parts, in the form that MCAP calls ``ros2msg``."""
    return messages().definition(name).encode()


def serialize(name: str, *values: Any) -> bytes:
    """CDR of a message whose fields are `values`, in order.

    Raises:
        CodecError: a value that does not fit its field.
    """
    return messages().encode(messages().types[name](*values))


def deserialize(name: str, data: bytes) -> Any:
    """The message that `serialize` was given. Raises CodecError: other bytes."""
    return messages().decode(name, data, MAX_MESSAGE_BYTES)


def header(stamp_ns: int, frame: str) -> Any:
    """A std_msgs/Header. Raises CodecError: the stamp lies after 2038 and does not fit."""
    types = messages().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if not 0 <= seconds < LAST_SECOND:
        raise CodecError("invalid", f"a stamp of {seconds} s does not fit into a ROS header")
    stamp = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return types["std_msgs/msg/Header"](stamp, frame)


def _pose(position_m: Any, quat_xyzw: Any) -> Any:
    types = messages().types
    return types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*(float(value) for value in position_m)),
        types["geometry_msgs/msg/Quaternion"](*(float(value) for value in quat_xyzw)),
    )


def _pose_stamped(fields: Mapping[str, Any]) -> list[Any]:
    return [_pose(fields["position_m"], fields["quat_xyzw"])]


def _pose_array(fields: Mapping[str, Any]) -> list[Any]:
    poses = zip(fields["position_m"], fields["quat_xyzw"], strict=True)
    return [[_pose(*pose) for pose in poses]]


def _joint_state(fields: Mapping[str, Any]) -> list[Any]:
    names = ("position_rad", "velocity_rad_s", "effort_nm")
    values = (() if fields.get(name) is None else fields[name] for name in names)
    arrays = (np.ascontiguousarray(value, np.float64) for value in values)
    return [list(fields["names"]), *arrays]


_VIEWS: dict[type, tuple[str, Callable[[Mapping[str, Any]], list[Any]]]] = {
    PoseState: (POSE, _pose_stamped),
    PoseCommand: (POSE, _pose_stamped),
    JointState: (JOINTS, _joint_state),
    JointCommand: (JOINTS, _joint_state),
    ObjectPoses: (POSES, _pose_array),
}


def standard_message(
    kind: type, fields: Mapping[str, Any], stamp_ns: int, frame: str
) -> tuple[str, bytes] | None:
    """Type and CDR of the standard message that shows a record; None where there is none.

    Raises:
        CodecError: fields that do not fit, such as arrays of another length.
    """
    if kind not in _VIEWS:
        return None
    name, values_of = _VIEWS[kind]
    try:
        return name, serialize(name, header(stamp_ns, frame), *values_of(fields))
    except (TypeError, ValueError, KeyError) as error:
        raise CodecError("invalid", f"{kind.__name__} does not fit into {name}: {error}") from error
