"""Messages that command a ROS 2 robot (poses, joint positions, gripper openings) or show status.

A pose can be sent as any message with a pose in it, your own too. Its fields are filled by their
types: ``geometry_msgs/Pose`` (or ``PoseStamped``) gets the pose, ``std_msgs/Header`` stamp and
frame, ``geometry_msgs/Twist`` the feed-forward velocity, and an array of as many numbers as the arm
has joints the posture of its nullspace. The rest stays zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.profile import GripperProfile
from vla_zenoh.profile.robot import Ros2Gripper
from vla_zenoh.types import FloatArray, GripperCommand, JointCommand, NodeStatus, PoseCommand
from vla_zenoh_ros2.keys import LOG
from vla_zenoh_ros2.messages import SECOND_NS, Messages

POSE, POSE_STAMPED = "geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
NUMBER, NUMBERS = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"
_HEADER, _TWIST = "std_msgs/msg/Header", "geometry_msgs/msg/Twist"
MOVE, GRASP = "franka_msgs/action/Move", "franka_msgs/action/Grasp"
GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
GRIPPER_MESSAGE = "control_msgs/msg/GripperCommand"
PARALLEL_COMMAND = "control_msgs/action/ParallelGripperCommand"
NOW_NS = 0
"""A trajectory's stamp of zero means: from now on, whatever the robot's clock says."""
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)
INFO = 20
"""rcl_interfaces/Log.INFO."""
BAD = frozenset(
    {
        "fault",
        "stopped",
        "degraded",
        "braking",
        "latched",
        "waiting",
        "silent",
        "stalled",
        "unheeded",
    }
)
MAX_VALUE = 200
PLAIN = (str, int, float, bool)


class Stamp(NamedTuple):
    """Stamp and frame for the header of a message."""

    stamp_ns: int
    frame: str


Write = Callable[[Any, Stamp], Any]
"""Command and stamp -> message."""


def header(messages: Messages, stamp: Stamp) -> Any:
    """A std_msgs/Header with this stamp and frame."""
    time = messages.new("builtin_interfaces/msg/Time", **_time_fields(stamp.stamp_ns))
    return messages.new(_HEADER, stamp=time, frame_id=stamp.frame)


def _time_fields(time_ns: int) -> dict[str, int]:
    """Fields of a builtin_interfaces/Time or Duration."""
    sec, nanosec = divmod(time_ns, SECOND_NS)
    return {"sec": sec, "nanosec": nanosec}


# -- joints ---------------------------------------------------------------------------------------
def joint_writer(messages: Messages, kind: str, lead_ns: int) -> Write:
    """How joint positions are written as `kind`.

    That is a trajectory of one point, which lies `lead_ns` ahead, or plain numbers, which the
    position controllers of ros2_control take in the order of the profile's arm_joints.

    Raises:
        ProfileError: it is another type.
    """

    def trajectory(command: JointCommand, stamp: Stamp) -> Any:
        lead = messages.new("builtin_interfaces/msg/Duration", **_time_fields(lead_ns))
        point = messages.new(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array(command.position_rad),
            velocities=np.array(command.velocity_rad_s),
            accelerations=np.array(command.acceleration_rad_s2),
            time_from_start=lead,
        )
        return messages.new(
            kind,
            header=header(messages, Stamp(NOW_NS, stamp.frame)),
            joint_names=list(command.names),
            points=[point],
        )

    def numbers(command: JointCommand, stamp: Stamp) -> Any:
        return messages.new(kind, data=np.array(command.position_rad))

    found = {TRAJECTORY: trajectory, NUMBERS: numbers}.get(kind)
    if found is None:
        raise ProfileError(f"joint positions cannot be sent as {kind}")
    return found


# -- poses ----------------------------------------------------------------------------------------
def pose_writer(messages: Messages, kind: str, posture_rad: FloatArray) -> Write:
    """How poses are written as `kind`, any type with a pose in it.

    Raises:
        ProfileError: it is no type, or has no field for a pose.
    """
    messages.require(kind)
    named = [what for node, what in messages.fields(kind).values() if node == Nodetype.NAME]
    if kind != POSE and not {POSE, POSE_STAMPED} & set(named):
        wanted = f"{POSE} or {POSE_STAMPED}"
        raise ProfileError(f"{kind} has no field of type {wanted} to put a pose into")

    def write(command: PoseCommand, stamp: Stamp) -> Any:
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
        return header(messages, stamp)
    if what == POSE:
        return _pose(messages, command)
    if what == POSE_STAMPED:
        pose = _pose(messages, command)
        return messages.new(POSE_STAMPED, header=header(messages, stamp), pose=pose)
    if what != _TWIST:
        return None
    linear, angular = np.split(command.twist, 2)
    return messages.new(
        _TWIST,
        linear=_xyz(messages, "geometry_msgs/msg/Vector3", linear),
        angular=_xyz(messages, "geometry_msgs/msg/Vector3", angular),
    )


def _pose(messages: Messages, command: PoseCommand) -> Any:
    x, y, z, w = command.quat_xyzw.tolist()
    return messages.new(
        POSE,
        position=_xyz(messages, "geometry_msgs/msg/Point", command.position_m),
        orientation=messages.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )


def _xyz(messages: Messages, kind: str, values: FloatArray) -> Any:
    x, y, z = values.tolist()
    return messages.new(kind, x=x, y=y, z=z)


# -- gripper --------------------------------------------------------------------------------------
def position(ros2: Ros2Gripper, gripper: GripperProfile, width_m: float) -> float:
    """The number that the gripper's driver takes for an opening: m, or rad of its joint."""
    if ros2.position == "joint" or (ros2.position is None and gripper.joint_ends is not None):
        return Fingers(gripper, 0).position(width_m)
    return width_m / 2 if ros2.position == "finger" else width_m


def send_goal(
    messages: Messages,
    action: str,
    goal_id: bytes,
    command: GripperCommand,
    *,
    position: float,
    max_width_m: float,
) -> Any:
    """The request that begins a goal with this id.

    `position` is the opening as the driver takes it; `MOVE` and `GRASP` take widths. A grasp
    succeeds at whatever width up to `max_width_m`.
    """
    goal: dict[str, Any] = {"width": command.width_m, "speed": command.speed_m_s}
    if action == GRASP:
        epsilon = messages.new("franka_msgs/msg/GraspEpsilon", inner=max_width_m, outer=max_width_m)
        goal |= {"epsilon": epsilon, "force": command.force_n}
    elif action == PARALLEL_COMMAND:
        # It has one joint, which needs no name; its speed, in the joint's unit, is the driver's.
        order = messages.new(
            "sensor_msgs/msg/JointState",
            position=np.array([position]),
            effort=np.array([command.force_n]),
        )
        goal = {"command": order}
    elif action == GRIPPER_COMMAND:
        order = messages.new(GRIPPER_MESSAGE, position=position, max_effort=command.force_n)
        goal = {"command": order}
    return messages.new(
        f"{action}_SendGoal_Request",
        goal_id=uuid(messages, goal_id),
        goal=messages.new(f"{action}_Goal", **goal),
    )


def uuid(messages: Messages, goal_id: bytes) -> Any:
    """A unique_identifier_msgs/UUID of 16 bytes."""
    return messages.new(
        "unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(goal_id, np.uint8).copy()
    )


def cancel(messages: Messages, goal_id: bytes) -> Any:
    """The request that ends this goal alone."""
    info = messages.new("action_msgs/msg/GoalInfo", goal_id=uuid(messages, goal_id))
    return messages.new("action_msgs/srv/CancelGoal_Request", goal_info=info)


def position_message(
    messages: Messages,
    kind: str,
    command: GripperCommand,
    joints: Mapping[str, float],
    position: float,
    travel_s: float,
) -> Any:
    """The opening of a gripper as its driver takes it: a `position`, in the type of a topic.

    A trajectory brings each of the finger `joints` to its own position, after `travel_s`.
    """
    if kind == GRIPPER_MESSAGE:
        return messages.new(kind, position=position, max_effort=command.force_n)
    if kind == TRAJECTORY:
        lead = messages.new(
            "builtin_interfaces/msg/Duration", **_time_fields(round(travel_s * SECOND_NS))
        )
        point = messages.new(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=np.array(list(joints.values())),
            time_from_start=lead,
        )
        return messages.new(kind, joint_names=list(joints), points=[point])
    return messages.new(kind, data=np.array([position]) if kind == NUMBERS else position)


# -- status of our nodes, for rqt_robot_monitor and the like --------------------------------------
def diagnostics(
    messages: Messages,
    robot: str,
    nodes: Mapping[str, tuple[NodeStatus, float, bool]],
    stamp: Stamp,
) -> Any:
    """One entry for each node of a robot; `nodes` has their status, its age in s, and alive."""
    return messages.new(
        DIAGNOSTICS,
        header=header(messages, stamp),
        status=[_diagnostic(messages, robot, *node) for node in nodes.values()],
    )


def _diagnostic(
    messages: Messages, robot: str, status: NodeStatus, age_s: float, alive: bool
) -> Any:
    level = STALE if not alive else WARN if status.state in BAD else OK
    if status.state == "fault":
        level = ERROR
    why = str(status.detail.get("why", ""))
    values = {
        "age_s": f"{age_s:.2f}",
        **{f"{name}_hz": f"{rate_hz:.1f}" for name, rate_hz in status.rates_hz.items()},
        **{
            f"{name}_ms": f"p50 {p50:.1f}, p95 {p95:.1f}"
            for name, (p50, p95) in status.latency_ms.items()
        },
        **{name: str(value) for name, value in status.detail.items() if isinstance(value, PLAIN)},
        **{name: str(count) for name, count in status.counters.items() if count},
    }
    return messages.new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=f"vla-zenoh/{robot}: {status.node}",
        message=f"{status.state}: {why}" if why else status.state,
        hardware_id=status.host,
        values=[
            messages.new("diagnostic_msgs/msg/KeyValue", key=key, value=value[:MAX_VALUE])
            for key, value in values.items()
        ],
    )


def log(messages: Messages, robot: str, text: str, stamp: Stamp) -> Any:
    """A rcl_interfaces/Log of level INFO, as ROS nodes publish them on /rosout."""
    time = messages.new("builtin_interfaces/msg/Time", **_time_fields(stamp.stamp_ns))
    return messages.new(LOG, stamp=time, level=INFO, name=f"vla_{robot}", msg=text)
