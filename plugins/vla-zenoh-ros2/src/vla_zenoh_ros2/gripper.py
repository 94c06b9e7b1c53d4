"""The gripper of a ROS 2 robot: by a topic of numbers, or by an action, one goal at a time.

The newest request wins. One that comes during a goal cancels it, and is sent once the robot has
ended it: never two goals at once, never a stop that overtakes its move. A waiting request is
dropped when its writer no longer controls the arm.
"""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError
from vla_zenoh.profile import GripperProfile, Profile
from vla_zenoh.profile.robot import GRIPPER_ACTIONS
from vla_zenoh.types import Event, GripperCommand
from vla_zenoh_ros2 import writers
from vla_zenoh_ros2.keys import COMMAND
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import outcome
from vla_zenoh_ros2.ros_graph import CALL_S, RosGraph, ServiceClient
from vla_zenoh_ros2.writers import GRASP

GOAL_TIMEOUT_S = 5.0
"""A goal is given up after this long without an answer, beyond the time that its fingers need."""
ID_BYTES = 16


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


class Gripper:
    """Sends accepted gripper commands to the arm of `profile`; without ros2.gripper it has none.

    `width` measures the opening between the fingers (m), None while unknown; `wanted_m` is that of
    the newest command, None before the first. `blocked` says why goals do not reach the action;
    `fingers` has the sign of each finger joint.
    """

    def __init__(
        self,
        node: Node,
        graph: RosGraph,
        messages: Messages,
        profile: Profile,
        width: Callable[[], float | None],
        blocked: Callable[[], str] = str,
        fingers: Mapping[str, float] | None = None,
    ) -> None:
        assert profile.ros2 is not None
        gripper = self._profile = profile.ros2.gripper
        self._node, self._messages = node, messages
        # Without a gripper nothing is commanded, and no limit is used.
        self._limits = profile.robot.gripper or GripperProfile(max_width_m=1.0)
        self._blocked, self._fingers = blocked, fingers or {}
        self._measured_m, self._sent_m = width, self._limits.max_width_m
        self._goals = GoalSequencer(GOAL_TIMEOUT_S, self._limits.max_width_m)
        self._answers: deque[Callable[[], None]] = deque()
        self._action = self._writer = ""
        self.wanted_m: float | None = None
        self._held = False
        self._clients: dict[str, dict[str, ServiceClient]] = {}
        self._topic = None
        if gripper is None:
            return
        if gripper.type in GRIPPER_ACTIONS:
            self._clients[gripper.type] = graph.action_client(gripper.topic, gripper.type)
            if gripper.grasp is not None:
                self._clients[GRASP] = graph.action_client(gripper.grasp, GRASP)
        else:
            self._topic = graph.publisher(gripper.topic, gripper.type, COMMAND)

    @property
    def busy(self) -> bool:
        """A goal is in flight."""
        return self._goals.goal is not None

    @property
    def holding(self) -> bool:
        """An object is between the fingers.

        A Franka's grasp succeeds where ``width - inner < d < width + outer`` holds for the distance
        d of its fingers. Both tolerances are the whole stroke here, as the thickness of the object
        is unknown: so it also succeeds on nothing, and d shows whether an object is held.

        Source: documentation of franka_gripper, ``grasp``.
        """
        if self._action != GRASP or not self._held:
            return self._held
        at_m = self._measured_m()
        return at_m is not None and at_m > self._sent_m + self._limits.dead_band_m

    def poll(self, writer: str, *, writer_active: bool) -> None:
        """Handle answers, and send or cancel the goal that is due; see `ArmGuard.writer`."""
        if self._writer and not writer_active:
            # The motion is over that the command belonged to, which waits for the goal in flight.
            dropped, self._goals.wish = self._goals.wish, None
            if dropped is not None:
                self.wanted_m = self._sent_m
                why = f"to {dropped.width_m:.3f} m waited when {self._writer[:60]!r} stopped"
                self._node.reject("outlived", f"command/gripper {why}")
        self._writer = writer if writer_active else ""
        while self._answers:
            self._answers.popleft()()
        self._advance()

    def _advance(self) -> None:
        step, goal = self._goals.step(time.monotonic_ns()), self._goals.goal
        self._node.counters["ros2.gripper_timeouts"] = self._goals.timeouts
        if goal is None:
            return
        if step == "send":
            self._send(goal)
        elif step == "cancel":
            self._node.counters["ros2.gripper_cancelled"] += 1
            request = writers.cancel(self._messages, goal.id)
            self._call("cancel_goal", request, lambda _: None)  # the goal's result follows

    def move(self, command: GripperCommand, now_ns: int) -> None:
        """Send a command, after the goal in flight ended; `now_ns` (wall clock) stamps it."""
        if self._profile is None:
            return
        if self._topic is None and (why := self._blocked()):
            self._node.reject("middleware", why, "command/gripper")
            return
        self.wanted_m = command.width_m
        if self._topic is None:
            self._goals.wish = command
            self._advance()
            return
        position = writers.position(self._profile, self._limits, command.width_m)
        message = writers.position_message(
            self._messages,
            self._profile.type,
            command,
            {name: sign * position for name, sign in self._fingers.items()},
            position,
            self._travel_s(command),
        )
        self._topic.publish(self._messages.encode(message))

    def _travel_s(self, command: GripperCommand) -> float:
        """How long the fingers take at the commanded speed."""
        measured_m = self._measured_m()
        at_m = self._sent_m if measured_m is None else measured_m
        self._sent_m = command.width_m
        return abs(command.width_m - at_m) / command.speed_m_s

    # -- the action ---------------------------------------------------------------------------
    def _send(self, goal: ActionGoal) -> None:
        assert self._profile is not None
        measured_m = self._measured_m()
        at_m = self._sent_m if measured_m is None else measured_m
        closes = goal.command.width_m < at_m - self._limits.dead_band_m
        use_grasp = closes and GRASP in self._clients
        self._sent_m = goal.command.width_m
        self._action = GRASP if use_grasp else self._profile.type
        self._held = False
        request = writers.send_goal(
            self._messages,
            self._action,
            goal.id,
            goal.command,
            position=writers.position(self._profile, self._limits, self._sent_m),
            max_width_m=self._limits.max_width_m,
        )
        self._node.counters["ros2.gripper_goals"] += 1
        self._call("send_goal", request, lambda answer: self._on_accepted(goal, answer))

    def _call(
        self,
        part: str,
        request: Any,
        done: Callable[[bytes | None], None],
        timeout_s: float = CALL_S,
    ) -> None:
        # Answers come on Zenoh's thread and are handled by the next `poll`.
        self._clients[self._action][part].call(
            self._messages.encode(request),
            lambda answer: self._answers.append(lambda: done(answer)),
            timeout_s,
        )

    def _on_accepted(self, goal: ActionGoal, answer: bytes | None) -> None:
        response = self._decode(f"{self._action}_SendGoal_Response", answer)
        if response is None or not response.accepted:
            if self._goals.ended(goal):
                self._emit_failure("does not answer" if response is None else "rejected the goal")
            return
        self._goals.accepted(goal, time.monotonic_ns())
        request = self._messages.new(
            f"{self._action}_GetResult_Request", goal_id=writers.uuid(self._messages, goal.id)
        )
        # As long as the goal may take, and the cancellation after it.
        timeout_s = self._goals.travel_s(goal) + 2 * GOAL_TIMEOUT_S
        self._call("get_result", request, lambda answer: self._on_result(goal, answer), timeout_s)

    def _on_result(self, goal: ActionGoal, answer: bytes | None) -> None:
        if not self._goals.ended(goal):
            return
        response = self._decode(f"{self._action}_GetResult_Response", answer)
        if response is None:
            self._emit_failure("does not report the result of the goal")
            return
        result = outcome(self._action, response)
        self._held = result.holding
        if not (result.reached or result.holding):
            self._emit_failure(f"did not get there (status {response.status}) {result.message}")

    def _decode(self, kind: str, answer: bytes | None) -> Any:
        if answer is None:
            return None
        try:
            return self._messages.decode(kind, answer)
        except CodecError as error:
            self._node.reject(error.reason, f"answer of {self._action}: {error}", self._action)
            return None

    def _emit_failure(self, what: str) -> None:
        assert self._profile is not None
        where = (self._action == GRASP and self._profile.grasp) or self._profile.topic
        why = f"the gripper at {where} {what}"
        self._node.emit(Event("warning", "fault", "gripper", why[:1000]))
