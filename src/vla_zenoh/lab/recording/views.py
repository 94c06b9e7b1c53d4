"""Standard ROS 2 messages made of our records, so that every viewer draws them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vla_zenoh.lab.recording import cdr
from vla_zenoh.types import JointCommand, JointState, ObjectPoses, PoseCommand, PoseState

POSE, JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"
POSES = "geometry_msgs/msg/PoseArray"


def _pose(position_m: Any, quat_xyzw: Any) -> Any:
    types = cdr.messages().types
    return types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*(float(value) for value in position_m)),
        types["geometry_msgs/msg/Quaternion"](*(float(value) for value in quat_xyzw)),
    )


def _pose_stamped(fields: dict[str, Any], header: Any) -> bytes:
    return cdr.serialize(POSE, header, _pose(fields["position_m"], fields["quat_xyzw"]))


def _joint_state(fields: dict[str, Any], header: Any) -> bytes:
    velocity = _numbers(fields["velocity_rad_s"])
    effort = _numbers(fields.get("effort_nm", ()))
    names, position = list(fields["names"]), _numbers(fields["position_rad"])
    return cdr.serialize(JOINTS, header, names, position, velocity, effort)


def _pose_array(fields: dict[str, Any], header: Any) -> bytes:
    poses = zip(fields["position_m"], fields["quat_xyzw"], strict=True)
    return cdr.serialize(POSES, header, [_pose(*pose) for pose in poses])


def _numbers(value: Any) -> Any:
    return np.ascontiguousarray(value, np.float64)


VIEWS: dict[type, tuple[str, Callable[[dict[str, Any], Any], bytes]]] = {
    PoseState: (POSE, _pose_stamped),
    PoseCommand: (POSE, _pose_stamped),
    JointState: (JOINTS, _joint_state),
    JointCommand: (JOINTS, _joint_state),
    ObjectPoses: (POSES, _pose_array),
}
"""Record -> the standard message that shows it, and what makes its CDR of (fields, header)."""
