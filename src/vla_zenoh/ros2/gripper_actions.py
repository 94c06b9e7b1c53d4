"""The actions by which a gripper may be commanded: goals out, results in, one goal at a time.

The newest request wins. One that comes during a goal cancels it, and is sent once the robot has
ended it: never two goals at once, never a stop that overtakes its move. A waiting request is
dropped when its writer no longer controls the arm.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

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
    """The request that begins a goal with an id of 16 bytes.

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
class GoalStep(Enum):
    SEND = "send"
    CANCEL = "cancel"


class ActionGoal(NamedTuple):
    """A goal, identified by its number."""

    number: int
    command: GripperCommand


class GoalSequencer:
    """Decides when a goal is sent or cancelled. Time is given in ns of any clock.

    A goal without any response is abandoned after `timeout_s`; an accepted one has in addition the
    time in which the fingers go `stroke_m`, their longest way, at its speed.
    """

    def __init__(self, timeout_s: float, stroke_m: float) -> None:
        self._timeout_ns, self._stroke_m = int(timeout_s * 1e9), stroke_m
        self._wish: GripperCommand | None = None
        self._accepted = self._cancelling = False
        self._since_ns = self._number = 0
        self.goal: ActionGoal | None = None
        self.timeouts = 0

    def want(self, command: GripperCommand) -> None:
        """Request an opening; replaces a request that was not sent."""
        self._wish = command

    def forget(self) -> GripperCommand | None:
        """Drop and return the request that was not sent."""
        wish, self._wish = self._wish, None
        return wish

    def accepted(self, number: int, now_ns: int) -> None:
        """The robot took the goal."""
        if self.goal is not None and number == self.goal.number:
            self._accepted, self._since_ns = True, now_ns

    def ended(self, number: int) -> bool:
        """The goal was rejected or has ended; False if it is an older one."""
        if self.goal is None or number != self.goal.number:
            return False
        self.goal = None
        return True

    def step(self, now_ns: int) -> GoalStep | None:
        """Next action: `GoalStep.SEND` for the new `goal`, `GoalStep.CANCEL` for the old one."""
        if self.goal is not None and now_ns - self._since_ns > self._patience_ns(self.goal):
            self.timeouts += 1
            self.goal = None
        if self._wish is None:
            return None
        if self.goal is None:
            self._number += 1
            self.goal, self._wish = ActionGoal(self._number, self._wish), None
            self._accepted = self._cancelling = False
            self._since_ns = now_ns
            return GoalStep.SEND
        if self._accepted and not self._cancelling:
            self._cancelling, self._since_ns = True, now_ns
            return GoalStep.CANCEL
        return None

    def travel_s(self, goal: ActionGoal) -> float:
        """How long the fingers may need for it."""
        return self._stroke_m / goal.command.speed_m_s

    def _patience_ns(self, goal: ActionGoal) -> int:
        moves = self._accepted and not self._cancelling
        return self._timeout_ns + (int(self.travel_s(goal) * 1e9) if moves else 0)
