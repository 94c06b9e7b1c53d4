"""Section ``robot`` of a profile, and those of its drivers: kinematics, gripper, arms, ROS 2."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple, get_args

from pydantic import AfterValidator, Field

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import NODE_KINDS
from vla_zenoh.profile.schema import Endpoints
from vla_zenoh.profile.section import (
    Angle,
    Fault,
    Name,
    Point,
    Range,
    Section,
    Text,
    Word,
    Words,
)

MAX_JOINTS = 16
"""Joints that an arm has at most."""
POSE_JOINTS = 6
"""Joints that an arm needs at least to reach every pose in its workspace."""


class JointEnds(NamedTuple):
    """Positions of a finger joint with the gripper open and shut, in ``rad`` or ``m``."""

    open: float
    shut: float
    unit: Literal["rad", "m"]


class GripperProfile(Section):
    """The gripper.

    Args:
        max_width_m: largest opening between the fingers.
        speed_m_s: of a command.
        force_n: of a command.
        dead_band_m: smaller changes of the width are not commanded.
        command_timeout_s: a gripper that has not reported standstill for this long counts as
            standing.
        joint_open_rad: angle of a revolute finger joint when the gripper is open by max_width_m.
        joint_shut_rad: its angle when the fingers meet; linear in between.
        joint_open_m: position of a prismatic finger joint when the gripper is open, if finger
            joints do not add up to the width.
        joint_shut_m: its position when the fingers meet.
    """

    max_width_m: float = Field(gt=0, le=1)
    speed_m_s: float = Field(default=0.1, ge=1e-4, le=1)
    force_n: float = Field(default=25.0, ge=0, le=500)
    dead_band_m: float = Field(default=0.001, gt=0, le=0.05)
    command_timeout_s: float = Field(default=2.0, gt=0, le=30)
    joint_open_rad: float | None = None
    joint_shut_rad: float | None = None
    joint_open_m: float | None = Field(default=None, ge=-1, le=1)
    joint_shut_m: float | None = Field(default=None, ge=-1, le=1)

    @property
    def joint_ends(self) -> JointEnds | None:
        """Ends of the finger joint; None if finger joints add up to the width."""
        if self.joint_open_rad is not None and self.joint_shut_rad is not None:
            return JointEnds(self.joint_open_rad, self.joint_shut_rad, "rad")
        if self.joint_open_m is not None and self.joint_shut_m is not None:
            return JointEnds(self.joint_open_m, self.joint_shut_m, "m")
        return None

    def contradictions(self) -> Iterator[Fault]:
        turning = (("joint_open_rad", self.joint_open_rad), ("joint_shut_rad", self.joint_shut_rad))
        sliding = (("joint_open_m", self.joint_open_m), ("joint_shut_m", self.joint_shut_m))
        for name, angle in turning:
            if angle is not None and abs(angle) > 2 * math.pi:
                yield (name,), f"is {angle:g}: more than a turn; give radians"
        for pair in (turning, sliding):
            (_, at_open), (_, at_shut) = pair
            if (at_open is None) != (at_shut is None):
                missing, given = pair if at_open is None else pair[::-1]
                yield (given[0],), f"needs {missing[0]} beside it"
            elif at_open is not None and at_open == at_shut:
                yield (pair[1][0],), f"is that of {pair[0][0]}: nothing would move"
        if all(any(value is not None for _, value in pair) for pair in (turning, sliding)):
            why = "is for a joint that slides, joint_open_rad for one that turns: give one of them"
            yield ("joint_open_m",), why


class RobotProfile(Section):
    """The robot and its description (URDF), shared by simulator and kinematics.

    Args:
        name: part of every key.
        driver: name of an installed plug-in: ``sim``: simulator; ``ros2``: controllers of a ROS 2
            robot; ``arm``: a Python file; ``franka``: a Franka arm over FCI; ``ur``: a UR arm over
            RTDE; ``lerobot``: a robot class of LeRobot; ``physicalai``: a robot that Intel's
            physicalai owns; ``franka_node``: a Franka arm behind franka-node; ``trossen``: a
            WidowX AI; packages bring more. What it needs to know is in the section of its name.
            The node of ``sim`` and ``ros2`` has their name, that of all others is ``arm``.
        command: set-points of the arm: ``pose`` of the TCP, for a Cartesian impedance controller,
            or ``joint`` positions.
        description: path of the URDF; ``shipped:`` and the name of one that comes with the package
            (panda.urdf, so101.urdf); ``example-robot-data:`` and a path in that package, of the
            extra ``meshes``.
        base_frame: link in which all poses are expressed.
        tcp_frame: link whose pose is controlled.
        arm_joints: in the order of every list of joint values in the profile.
        joint_range_rad: lower and upper end for each of arm_joints, within those of the
            description, null: those; empty: those of all. m for a joint that slides, here and in
            home_rad.
        locked_rad: where joints stand that lie between base_frame and tcp_frame and are not
            commanded, as a torso: name -> rad, or m where it slides.
        finger_joints: of the gripper; their states give its width. Prismatic ones add up to it; for
            revolute ones `gripper` defines where they are open and shut.
        home_rad: joint positions of the simulated arm after a reset.
        posture: joint positions that a redundant arm keeps its elbow close to: ``start``, those at
            activation, or ``home``, to which the elbow then moves at once if joints are commanded.
        gripper: its own section; without it the robot has none.
    """

    name: Name
    driver: Name = "sim"
    command: Literal["pose", "joint"] = "pose"
    description: Word
    base_frame: Word
    tcp_frame: Word
    arm_joints: Words = Field(min_length=1)
    joint_range_rad: Annotated[tuple[Range | None, ...], Field(strict=False)] = ()
    locked_rad: dict[Word, float] = Field(default_factory=dict)
    finger_joints: Words = ()
    home_rad: tuple[float, ...] = Field(strict=False)
    posture: Literal["start", "home"] = "start"
    gripper: GripperProfile | None = None

    @property
    def node(self) -> str:
        """Kind of the node that drives it."""
        traits = NODE_KINDS.get(self.driver)
        return self.driver if traits is not None and traits.role == "robot" else "arm"

    @property
    def max_width_m(self) -> float:
        """Largest opening of the gripper; NaN, which nothing fits into, without one."""
        return math.nan if self.gripper is None else self.gripper.max_width_m

    def require_gripper(self, what: str) -> GripperProfile:
        """The gripper that `what` needs; a `ProfileError` if there is none."""
        if self.gripper is None:
            raise ProfileError(f"{what}: {self.no_gripper}")
        return self.gripper

    @property
    def no_gripper(self) -> str:
        """Sentence of a robot without a gripper; empty: it has one."""
        if self.gripper is not None:
            return ""
        return f"robot {self.name!r} has no gripper: its profile declares none (robot.gripper)"

    def contradictions(self) -> Iterator[Fault]:
        joints, home, ranges = len(self.arm_joints), len(self.home_rad), len(self.joint_range_rad)
        if joints > MAX_JOINTS:
            yield ("arm_joints",), f"has {joints} joints: at most {MAX_JOINTS} are commanded"
        if home != joints:
            yield ("home_rad",), f"has {home} angles for {joints} arm_joints"
        if ranges not in (0, joints):
            yield ("joint_range_rad",), f"has {ranges} pairs for {joints} arm_joints"
        for index, angle in enumerate(self.home_rad):
            if abs(angle) > 2 * math.pi:
                yield ("home_rad", str(index)), f"is {angle:g}: more than a turn; give radians"
        for index, ends in enumerate(self.joint_range_rad):
            if ends is not None and max(map(abs, ends)) > 4 * math.pi:
                why = f"is {ends[0]:g} to {ends[1]:g}: more than two turns; give radians"
                yield ("joint_range_rad", str(index)), why
        for name in sorted(set(self.arm_joints) & self.locked_rad.keys()):
            yield ("locked_rad", name), "is in arm_joints, too: it cannot stand still and move"
        if shared := sorted(set(self.arm_joints) & set(self.finger_joints)):
            yield ("finger_joints",), f"repeats arm_joints: {', '.join(shared)}"
        if self.gripper is None:
            if self.finger_joints:
                width = "gripper: {max_width_m: ...}, its largest opening"
                yield ("finger_joints",), f"needs robot.gripper beside it: {width}"
        elif self.gripper.dead_band_m >= self.gripper.max_width_m:
            width = f"max_width_m ({self.gripper.max_width_m:g})"
            yield ("gripper", "dead_band_m"), f"must be less than {width}: nothing would move"


class PartBase(Section):
    """Where a part stands, in the frame of the robot.

    Args:
        position_m: of its base frame.
        yaw_rad: its turn about the vertical.
    """

    position_m: Point = (0.0, 0.0, 0.0)
    yaw_rad: Angle = 0.0


def _option(value: str) -> str:
    if not value.isidentifier():
        raise ValueError(f"{value[:80]!r} cannot be the name of an option")
    return value


Options = dict[Annotated[str, AfterValidator(_option)], Text]
"""Keyword arguments of a class in a Python file, as text."""


# -- ROS 2: transport, topics and types -----------------------------------------------------------
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

GripperAction = Literal[
    "franka_msgs/action/Move",
    "franka_msgs/action/Grasp",
    "control_msgs/action/GripperCommand",
    "control_msgs/action/ParallelGripperCommand",
]
GripperTopic = Literal[
    "std_msgs/msg/Float64",
    "std_msgs/msg/Float64MultiArray",
    "control_msgs/msg/GripperCommand",
    "trajectory_msgs/msg/JointTrajectory",
]
GRIPPER_ACTIONS: tuple[GripperAction, ...] = get_args(GripperAction)


ImageType = Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"]


class Ros2Depth(Section):
    """A topic of depth images, of the same view as the colours (aligned, registered).

    Args:
        topic: its name.
        type: raw, or compressed as a PNG of 16 bits.
    """

    topic: Topic
    type: ImageType = "sensor_msgs/msg/Image"


class Ros2Camera(Section):
    """A camera topic.

    Args:
        topic: its name.
        type: raw or compressed.
        frame: required frame_id of its images; None: any.
        depth: topic of its depth; goes with ``depth_unit_m`` of the camera.
    """

    topic: Topic
    type: ImageType = "sensor_msgs/msg/Image"
    frame: Word | None = None
    depth: Ros2Depth | None = None


class Ros2Output(Section):
    """A topic that commands the arm.

    Args:
        topic: its name.
        type: for poses geometry_msgs/msg/PoseStamped,
            multi_mode_control_msgs/msg/CartesianImpedanceGoal, or any other type with a pose; for
            joints trajectory_msgs/msg/JointTrajectory or std_msgs/msg/Float64MultiArray.
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
        exerted_by: ``surroundings``, on the arm; or ``arm``, on them, as Franka's
            `O_F_ext_hat_K`, whose sign is turned.
    """

    topic: Topic
    frame: Word | None = None
    exerted_by: Literal["surroundings", "arm"] = "surroundings"


class Ros2Gripper(Section):
    """The action or topic that commands the gripper.

    Args:
        topic: name of the action or topic.
        type: one of `GRIPPER_ACTIONS`, which reach no gripper whose node uses Fast DDS; or of a
            topic: a plain number, a GripperCommand, or a trajectory of robot.finger_joints.
        grasp: action of franka_msgs/action/Grasp that closes, if ``topic`` only moves.
        position: meaning of the number that is sent, if the type leaves it open: ``width``, m
            between the fingers; ``finger``, m of one finger, half of that; ``joint``, m or rad of
            the finger joint, by ``joint_open`` and ``joint_shut`` of robot.gripper. None: ``joint``
            if robot.gripper has those; otherwise it is required.
    """

    topic: Topic
    type: Literal[GripperAction, GripperTopic]
    grasp: Topic | None = None
    position: Literal["width", "finger", "joint"] | None = None


class Ros2Profile(Section):
    """Transport and topics of a ROS 2 robot.

    Args:
        bridge: ``ros2dds``: zenoh-bridge-ros2dds; ``rmw_zenoh``: the robot runs rmw_zenoh.
        connect: endpoints of bridge or router; None: those of session.connect.
        distribution: of the robot; type hashes are part of names.
        domain: ROS domain id.
        use_sim_time: the robot's stamps are simulated time (Gazebo, Isaac Sim), at any rate; it is
            translated by the arrivals of joint states.
        joint_states: topic of sensor_msgs/JointState with the arm's joints.
        finger_states: topic with the finger joints, if they are on another one.
        wrench: external wrench at the TCP; ``limits.contact`` has no effect without it.
        cameras: camera of the profile -> topic.
        pose_command: topic for poses.
        joint_command: topic for joint positions.
        gripper: action or topic for the gripper.
        messages: type -> file with its definition, relative to the profile, for types that neither
            ROS nor this package has.
        prefix: of our own topics and services, as ``/vla/stop``; null: none.
        services: offer services beside these topics. They reach only callers of the robot's own
            rmw_zenoh, or of Cyclone DDS: with ROS 2's default, Fast DDS, a call waits for ever.
        tf: publish set-point, links of the arms and mounts of cameras on /tf and /tf_static, each
            unless a node of the robot publishes it, and compare the robot's frames with ours.
    """

    bridge: Literal["ros2dds", "rmw_zenoh"] = "ros2dds"
    connect: Endpoints | None = None
    distribution: Literal["humble", "iron", "jazzy", "kilted", "lyrical"] = "jazzy"
    domain: int = Field(default=0, ge=0, le=232)
    use_sim_time: bool = False
    joint_states: Topic = "/joint_states"
    finger_states: Topic | None = None
    wrench: Ros2Wrench | None = None
    cameras: dict[Name, Ros2Camera] = Field(default_factory=dict)
    pose_command: Ros2Output | None = None
    joint_command: Ros2Output | None = None
    gripper: Ros2Gripper | None = None
    messages: dict[RosType, Word] = Field(default_factory=dict)
    prefix: Topic | None = "/vla"
    services: bool = False
    tf: bool = False
