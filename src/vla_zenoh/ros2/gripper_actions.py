"""The actions by which a gripper may be commanded: goals out, results in, one goal at a time.

The newest request wins. One that comes during a goal cancels it, and is sent once the robot has
ended it: never two goals at once, never a stop that overtakes its move. A waiting request is
dropped when its writer no longer controls the arm.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.profile import GripperProfile
from vla_zenoh.profile.robot import Ros2Gripper
from vla_zenoh.ros2.messages import Messages
from vla_zenoh.types import GripperCommand

MOVE, GRASP = "franka_msgs/action/Move", "franka_msgs/action/Grasp"
GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
PARALLEL_COMMAND = "control_msgs/action/ParallelGripperCommand"
SUCCEEDED = 4
"""action_msgs/GoalStatus.STATUS_SUCCEEDED."""
ID_BYTES = 16


class GripperOutcome(NamedTuple):
    """Result of a goal, with the driver's message."""

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
    """The request that begins a goal with this id.

    `position` is the opening as the driver takes it, see the function; `MOVE` and `GRASP` take
    widths. A grasp succeeds at whatever width up to `max_width_m`.
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
        order = messages.new(
            "control_msgs/msg/GripperCommand", position=position, max_effort=command.force_n
        )
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


def outcome(action: str, response: Any) -> GripperOutcome:
    """Outcome of a goal by the answer of get_result."""
    result = response.result
    reached = response.status == SUCCEEDED
    if action in (GRIPPER_COMMAND, PARALLEL_COMMAND):
        return GripperOutcome(reached and bool(result.reached_goal), bool(result.stalled), "")
    success = reached and bool(result.success)
    return GripperOutcome(success, success and action == GRASP, str(result.error)[:300])


# -- order of goals -------------------------------------------------------------------------------
@dataclass(eq=False, slots=True)
class ActionGoal:
    """A goal, and when it was sent, accepted or cancelled last."""

    command: GripperCommand
    since_ns: int
    accepted: bool = False
    cancelling: bool = False
    id: bytes = field(default_factory=lambda: secrets.token_bytes(ID_BYTES))


class GoalSequencer:
    """Decides when a goal is sent or cancelled. Time is given in ns of any clock.

    A goal without any response is abandoned after `timeout_s`; an accepted one has in addition the
    time in which the fingers go `stroke_m`, their longest way, at its speed.

    Attributes:
        wish: the newest request, until it is sent.
        goal: in flight.
    """

    def __init__(self, timeout_s: float, stroke_m: float) -> None:
        self._timeout_s, self._stroke_m = timeout_s, stroke_m
        self.wish: GripperCommand | None = None
        self.goal: ActionGoal | None = None
        self.timeouts = 0

    def accepted(self, goal: ActionGoal, now_ns: int) -> None:
        """The robot took the goal."""
        goal.accepted, goal.since_ns = True, now_ns

    def ended(self, goal: ActionGoal) -> bool:
        """The goal was rejected or has ended; False if it is an older one."""
        if goal is not self.goal:
            return False
        self.goal = None
        return True

    def step(self, now_ns: int) -> Literal["send", "cancel"] | None:
        """Next action: send the new `goal`, or cancel the old one."""
        goal = self.goal
        if goal is not None:
            moves_s = self.travel_s(goal) if goal.accepted and not goal.cancelling else 0.0
            if now_ns - goal.since_ns > (self._timeout_s + moves_s) * 1e9:
                self.timeouts += 1
                self.goal = goal = None
        if self.wish is None:
            return None
        if goal is None:
            self.goal, self.wish = ActionGoal(self.wish, now_ns), None
            return "send"
        if goal.accepted and not goal.cancelling:
            goal.cancelling, goal.since_ns = True, now_ns
            return "cancel"
        return None

    def travel_s(self, goal: ActionGoal) -> float:
        """How long the fingers may need for it."""
        return self._stroke_m / goal.command.speed_m_s
