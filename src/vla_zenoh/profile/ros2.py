"""The part of a profile that describes a ROS 2 robot: topics, types and the way in."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vla_zenoh.profile.section import Name, Section, Word
from vla_zenoh.profile.session import Endpoints

_TOPIC = re.compile(r"(?:/[A-Za-z_{}~][A-Za-z0-9_{}~]*)+")
_TYPE = re.compile(r"[a-z][a-z0-9_]*/(?:msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")


def _topic(value: str) -> str:
    if not _TOPIC.fullmatch(value):
        raise ValueError(
            f"{value[:80]!r} is not a ROS topic: write its full name, as /joint_states"
        )
    return value


def _type(value: str) -> str:
    if not _TYPE.fullmatch(value):
        raise ValueError(f"{value[:80]!r} is not a ROS type: write package/msg/Name")
    return value


Topic = Annotated[str, Field(max_length=256), AfterValidator(_topic)]
RosType = Annotated[str, Field(max_length=256), AfterValidator(_type)]

JOINT_COMMANDS = ("trajectory_msgs/msg/JointTrajectory", "std_msgs/msg/Float64MultiArray")
GRIPPER_ACTIONS = (
    "franka_msgs/action/Move",
    "franka_msgs/action/Grasp",
    "control_msgs/action/GripperCommand",
    "control_msgs/action/ParallelGripperCommand",
)


class Ros2Camera(Section):
    """A camera topic.

    Args:
        topic: its name.
        type: raw or compressed.
        frame: frame_id its pictures must have; None: any.
    """

    topic: Topic
    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = (
        "sensor_msgs/msg/Image"
    )
    frame: Word | None = None


class Ros2Output(Section):
    """A topic the arm is commanded by.

    Args:
        topic: its name.
        type: for poses geometry_msgs/msg/PoseStamped,
            multi_mode_control_msgs/msg/CartesianImpedanceGoal, or any other with a pose in it; for
            joints one of `JOINT_COMMANDS`.
        frame: frame_id of its header; None: robot.base_frame.
    """

    topic: Topic
    type: RosType
    frame: Word | None = None


class Ros2Wrench(Section):
    """A topic of geometry_msgs/WrenchStamped.

    Args:
        topic: its name.
        frame: frame_id it must have, whose axes are those of robot.base_frame; None: that one.
    """

    topic: Topic
    frame: Word | None = None


class Ros2Gripper(Section):
    """What the gripper is commanded by: an action, or a topic of numbers.

    Args:
        topic: name of the action or topic.
        type: one of `GRIPPER_ACTIONS`, or a topic of plain numbers.
        grasp: action of franka_msgs/action/Grasp that closes, where ``topic`` only moves.
        position: what the number means that is sent, where the type does not say it: ``width``, the
            m between the fingers; ``finger``, the m of one of them, half of that; ``joint``, the m
            or rad of the finger joint, by the ``joint_open`` and ``joint_shut`` of robot.gripper.
            None: ``joint`` where robot.gripper has those; else it has to be said.
    """

    topic: Topic
    type: Literal[
        "franka_msgs/action/Move",
        "franka_msgs/action/Grasp",
        "control_msgs/action/GripperCommand",
        "control_msgs/action/ParallelGripperCommand",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float64MultiArray",
    ]
    grasp: Topic | None = None
    position: Literal["width", "finger", "joint"] | None = None

    @property
    def says_width(self) -> bool:
        """The type itself means the width."""
        return self.type.startswith("franka_msgs/")


class Ros2Profile(Section):
    """Topics of a ROS 2 robot.

    Args:
        bridge: ``ros2dds``: zenoh-bridge-ros2dds; ``rmw_zenoh``: the robot runs rmw_zenoh.
        connect: where bridge or router are; None: as session.connect says.
        distribution: of the robot; its type hashes are part of names.
        domain: ROS domain id.
        joint_states: topic of sensor_msgs/JointState with the arm's joints.
        finger_states: likewise with those of the fingers, where they come on another topic.
        tcp: ``kinematics``: the TCP is where our own kinematics put it; ``tf``: where /tf says.
        wrench: external wrench at the TCP; without it ``limits.contact`` has nothing to look at.
        cameras: camera of the profile -> topic.
        pose_command: where poses go.
        joint_command: where joint positions go.
        gripper: where gripper commands go.
        messages: type -> file with its definition, for types that ROS and we do not have; a path
            beside the profile.
        services: what our own services and topics begin with; null: there are none.
    """

    bridge: Literal["ros2dds", "rmw_zenoh"] = "ros2dds"
    connect: Endpoints | None = None
    distribution: Literal["humble", "iron", "jazzy", "kilted", "lyrical"] = "jazzy"
    domain: int = Field(default=0, ge=0, le=232)
    joint_states: Topic = "/joint_states"
    finger_states: Topic | None = None
    tcp: Literal["kinematics", "tf"] = "kinematics"
    wrench: Ros2Wrench | None = None
    cameras: dict[Name, Ros2Camera] = Field(default_factory=dict)
    pose_command: Ros2Output | None = None
    joint_command: Ros2Output | None = None
    gripper: Ros2Gripper | None = None
    messages: dict[RosType, Word] = Field(default_factory=dict)
    services: Topic | None = "/vla"
