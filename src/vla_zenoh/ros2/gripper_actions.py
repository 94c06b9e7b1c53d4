"""The actions by which a gripper may be commanded: goals out, results in."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.profile import GripperProfile
from vla_zenoh.profile.ros2 import Ros2Gripper
from vla_zenoh.ros2.messages import Messages
from vla_zenoh.ros2.names import request_of, send_goal_of
from vla_zenoh.types import GripperCommand

MOVE, GRASP = "franka_msgs/action/Move", "franka_msgs/action/Grasp"
GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
PARALLEL_COMMAND = "control_msgs/action/ParallelGripperCommand"
SUCCEEDED = 4
"""action_msgs/GoalStatus.STATUS_SUCCEEDED."""


class GripperOutcome(NamedTuple):
    """Result of a goal: reached, holding an object, and the driver's message."""

    reached: bool
    holding: bool
    message: str


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
    """The request that begins a goal.

    Args:
        messages: of the robot's distribution.
        action: one of the four.
        goal_id: 16 bytes.
        command: opening, speed and force.
        position: the opening as the driver takes it, see `position`; `MOVE`, `GRASP` take widths.
        max_width_m: a grasp succeeds at whatever width up to this.
    """
    if action == MOVE:
        goal = {"width": command.width_m, "speed": command.speed_m_s}
    elif action == GRASP:
        epsilon = messages.new("franka_msgs/msg/GraspEpsilon", inner=max_width_m, outer=max_width_m)
        goal = {
            "width": command.width_m,
            "epsilon": epsilon,
            "speed": command.speed_m_s,
            "force": command.force_n,
        }
    elif action == PARALLEL_COMMAND:
        # It has one joint, which needs no name; its speed, in the joint's unit, is the driver's.
        order = messages.new(
            "sensor_msgs/msg/JointState",
            position=np.array([position]),
            effort=np.array([command.force_n]),
        )
        goal = {"command": order}
    else:
        order = messages.new(
            "control_msgs/msg/GripperCommand", position=position, max_effort=command.force_n
        )
        goal = {"command": order}
    return messages.new(
        request_of(send_goal_of(action)),
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


def outcome(action: str, response: Any) -> GripperOutcome:
    """Outcome of a goal by the answer of get_result."""
    result = response.result
    reached = response.status == SUCCEEDED
    if action in (GRIPPER_COMMAND, PARALLEL_COMMAND):
        return GripperOutcome(reached and bool(result.reached_goal), bool(result.stalled), "")
    success = reached and bool(result.success)
    return GripperOutcome(success, success and action == GRASP, str(result.error)[:300])
