"""Section ``ros2`` of a profile: transport, topics and types of a ROS 2 robot."""

from __future__ import annotations

import re
from typing import Annotated, Literal, get_args

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
GripperAction = Literal[
    "franka_msgs/action/Move",
    "franka_msgs/action/Grasp",
    "control_msgs/action/GripperCommand",
    "control_msgs/action/ParallelGripperCommand",
]
GRIPPER_ACTIONS: tuple[GripperAction, ...] = get_args(GripperAction)


class Ros2Camera(Section):
    """A camera topic.

    Args:
        topic: its name.
        type: raw or compressed.
        frame: required frame_id of its images; None: any.
    """

    topic: Topic
    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = (
        "sensor_msgs/msg/Image"
    )
    frame: Word | None = None


class Ros2Output(Section):
    """A topic that commands the arm.

    Args:
        topic: its name.
        type: for poses geometry_msgs/msg/PoseStamped,
            multi_mode_control_msgs/msg/CartesianImpedanceGoal, or any other type with a pose; for
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
        frame: required frame_id; its axes are those of robot.base_frame. None: that frame.
    """

    topic: Topic
    frame: Word | None = None


class Ros2Gripper(Section):
    """The action or topic that commands the gripper.

    Args:
        topic: name of the action or topic.
        type: one of `GRIPPER_ACTIONS`, or a topic of plain numbers.
        grasp: action of franka_msgs/action/Grasp that closes, if ``topic`` only moves.
        position: meaning of the number that is sent, if the type leaves it open: ``width``, m
            between the fingers; ``finger``, m of one finger, half of that; ``joint``, m or rad of
            the finger joint, by ``joint_open`` and ``joint_shut`` of robot.gripper. None: ``joint``
            if robot.gripper has those; otherwise it is required.
    """

    topic: Topic
    type: Literal[GripperAction, "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"]
    grasp: Topic | None = None
    position: Literal["width", "finger", "joint"] | None = None

    @property
    def says_width(self) -> bool:
        """Whether the type itself defines the number as the width."""
        return self.type.startswith("franka_msgs/")


class Ros2Profile(Section):
    """Transport and topics of a ROS 2 robot.

    Args:
        bridge: ``ros2dds``: zenoh-bridge-ros2dds; ``rmw_zenoh``: the robot runs rmw_zenoh.
        connect: endpoints of bridge or router; None: those of session.connect.
        distribution: of the robot; type hashes are part of names.
        domain: ROS domain id.
        joint_states: topic of sensor_msgs/JointState with the arm's joints.
        finger_states: topic with the finger joints, if they are on another one.
        wrench: external wrench at the TCP; ``limits.contact`` has no effect without it.
        cameras: camera of the profile -> topic.
        pose_command: topic for poses.
        joint_command: topic for joint positions.
        gripper: action or topic for the gripper.
        messages: type -> file with its definition, relative to the profile, for types that neither
            ROS nor this package has.
        services: prefix of our own services and topics; null: none.
    """

    bridge: Literal["ros2dds", "rmw_zenoh"] = "ros2dds"
    connect: Endpoints | None = None
    distribution: Literal["humble", "iron", "jazzy", "kilted", "lyrical"] = "jazzy"
    domain: int = Field(default=0, ge=0, le=232)
    joint_states: Topic = "/joint_states"
    finger_states: Topic | None = None
    wrench: Ros2Wrench | None = None
    cameras: dict[Name, Ros2Camera] = Field(default_factory=dict)
    pose_command: Ros2Output | None = None
    joint_command: Ros2Output | None = None
    gripper: Ros2Gripper | None = None
    messages: dict[RosType, Word] = Field(default_factory=dict)
    services: Topic | None = "/vla"
