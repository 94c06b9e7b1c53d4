"""The part of a profile that describes a ROS 2 robot: topics, types and the way in."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Topic = Annotated[str, Field(pattern=r"^/[A-Za-z0-9_/~{}]+$")]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Ros2Camera(_Section):
    """A camera topic."""

    topic: Topic
    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = (
        "sensor_msgs/msg/Image"
    )


class Ros2Output(_Section):
    """A topic or action the robot is commanded by."""

    topic: Topic
    type: str


class Ros2Profile(_Section):
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
    cameras: dict[str, Ros2Camera] = {}
    pose_command: Ros2Output
    gripper: Ros2Output | None = None
