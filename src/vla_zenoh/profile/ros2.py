"""The part of a profile that describes a ROS 2 robot: topics, types and the way in."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vla_zenoh.profile.section import Name, Section, Word

_TOPIC = re.compile(r"(?:/[A-Za-z_{}~][A-Za-z0-9_{}~]*)+")


def _topic(value: str) -> str:
    if not _TOPIC.fullmatch(value):
        raise ValueError(
            f"{value[:80]!r} is not a ROS topic: write its full name, as /joint_states"
        )
    return value


Topic = Annotated[str, Field(max_length=256), AfterValidator(_topic)]


class Ros2Camera(Section):
    """A camera topic."""

    topic: Topic
    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = (
        "sensor_msgs/msg/Image"
    )


class Ros2Output(Section):
    """A topic or action the robot is commanded by."""

    topic: Topic
    type: Word


class Ros2Profile(Section):
    """Topics of a ROS 2 robot.

    Args:
        bridge: ``ros2dds``: zenoh-bridge-ros2dds; ``rmw_zenoh``: the robot runs rmw_zenoh.
        domain: ROS domain id.
        joint_states: topic of sensor_msgs/JointState.
        cameras: camera of the profile -> topic.
        pose_command: where poses go.
        gripper: where gripper commands go, with the actions of franka_msgs or a width topic.
    """

    bridge: Literal["ros2dds", "rmw_zenoh"] = "ros2dds"
    domain: int = Field(default=0, ge=0, le=232)
    joint_states: Topic = "/joint_states"
    cameras: dict[Name, Ros2Camera] = Field(default_factory=dict)
    pose_command: Ros2Output
    gripper: Ros2Output | None = None
