"""The gripper of a ROS 2 Panda: the action franka_msgs/action/Move, one goal at a time.

A goal that comes while the fingers still move ends the one before it (aborted), as the gripper's
own firmware does; a goal that is cancelled stops them where they are.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from ros_messages import (
    CancelGoalRequest,
    CancelGoalResponse,
    GoalInfo,
    GoalStatus,
    GoalStatusArray,
    MoveFeedback,
    MoveFeedbackMessage,
    MoveGetResultRequest,
    MoveGetResultResponse,
    MoveGoal,
    MoveResult,
    MoveSendGoalRequest,
    MoveSendGoalResponse,
    Time,
    Uuid,
)
from ros_node import RosNode

from vla_zenoh.simulation.world import World

EXECUTING, SUCCEEDED, CANCELED, ABORTED = 2, 4, 5, 6
FORCE_N = 25.0
FEEDBACK_EVERY, POLL_EVERY = 100, 2
MIN_TICKS = 50
"""The fingers are given this long to begin."""
CLOSE_M = 0.002
FORGET_AFTER = 20


@dataclass
class Goal:
    """One order, from its acceptance on."""

    id: tuple[int, ...]
    order: MoveGoal
    accepted: Time
    status: int = EXECUTING
    ticks: int = 0
    error: str = ""
    waiting: list[MoveGetResultRequest] = field(default_factory=list)


class MoveServer:
    """See the module.

    Args:
        node: whose action it is.
        name: of the action.
        world: its gripper is moved.
    """

    def __init__(self, node: RosNode, name: str, world: World) -> None:
        self._world = world
        self._goals: dict[tuple[int, ...], Goal] = {}
        self._current: Goal | None = None
        self._ticks = 0
        base = f"{name}/_action"
        self._send = node.server(
            f"{base}/send_goal", MoveSendGoalRequest, MoveSendGoalResponse, self._accept
        )
        self._cancel = node.server(
            f"{base}/cancel_goal", CancelGoalRequest, CancelGoalResponse, self._end_early
        )
        self._result = node.server(
            f"{base}/get_result", MoveGetResultRequest, MoveGetResultResponse, self._tell_result
        )
        self._feedback = node.publisher(f"{base}/feedback", MoveFeedbackMessage)
        self._status = node.publisher(f"{base}/status", GoalStatusArray, kept=True, depth=1)

    def tick(self) -> None:
        """One tick of the robot on."""
        self._ticks += 1
        if self._ticks % POLL_EVERY == 0:
            for server in (self._send, self._cancel, self._result):
                server.poll()
        goal = self._current
        if goal is None:
            return
        goal.ticks += 1
        state = self._world.gripper_state()
        if goal.ticks % FEEDBACK_EVERY == 0:
            self._feedback.write(
                MoveFeedbackMessage(Uuid(list(goal.id)), MoveFeedback(state.width_m))
            )
        if goal.ticks > MIN_TICKS and not state.moving:
            there = abs(state.width_m - goal.order.width) < CLOSE_M
            goal.error = "" if there else f"stands at {state.width_m:.4f} m"
            self._finish(goal, SUCCEEDED if there else ABORTED)

    def _accept(self, request: MoveSendGoalRequest) -> MoveSendGoalResponse:
        order = request.goal
        accepted = 0.0 <= order.width <= 0.08 and order.speed > 0.0
        now = Time.of(time.time_ns())
        if accepted:
            if self._current is not None:
                self._current.error = "another goal came"
                self._finish(self._current, ABORTED)
            goal = Goal(tuple(request.goal_id.uuid), order, now)
            self._goals[goal.id] = self._current = goal
            self._world.set_gripper(order.width, order.speed, FORCE_N)
            for old in list(self._goals)[:-FORGET_AFTER]:
                del self._goals[old]
            self._tell_status()
        return MoveSendGoalResponse(request.client, request.number, accepted, now)

    def _end_early(self, request: CancelGoalRequest) -> CancelGoalResponse:
        goal, asked = self._current, tuple(request.goal_info.goal_id.uuid)
        ended = []
        # An id of zeros means every goal.
        if goal is not None and asked in (goal.id, (0,) * 16):
            self._world.set_gripper(self._world.gripper_state().width_m, 0.1, FORCE_N)
            goal.error = "cancelled"
            self._finish(goal, CANCELED)
            ended.append(GoalInfo(Uuid(list(goal.id)), goal.accepted))
        return CancelGoalResponse(request.client, request.number, 0 if ended else 1, ended)

    def _tell_result(self, request: MoveGetResultRequest) -> MoveGetResultResponse | None:
        goal = self._goals.get(tuple(request.goal_id.uuid))
        if goal is None:
            unknown = MoveResult(False, "unknown goal")
            return MoveGetResultResponse(request.client, request.number, 0, unknown)
        if goal.status == EXECUTING:
            goal.waiting.append(request)
            return None
        return _result(request, goal)

    def _finish(self, goal: Goal, status: int) -> None:
        goal.status = status
        if goal is self._current:
            self._current = None
        for request in goal.waiting:
            self._result.reply(_result(request, goal))
        goal.waiting.clear()
        self._tell_status()

    def _tell_status(self) -> None:
        self._status.write(
            GoalStatusArray(
                [
                    GoalStatus(GoalInfo(Uuid(list(goal.id)), goal.accepted), goal.status)
                    for goal in self._goals.values()
                ]
            )
        )


def _result(request: MoveGetResultRequest, goal: Goal) -> MoveGetResultResponse:
    result = MoveResult(goal.status == SUCCEEDED, goal.error)
    return MoveGetResultResponse(request.client, request.number, goal.status, result)
