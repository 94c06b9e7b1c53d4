"""The gripper of a ROS 2 robot: by an action, one goal at a time, or by a topic of numbers."""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.gripper_guard import GripperGuard
from vla_zenoh.interop.ros2 import gripper_actions, table
from vla_zenoh.interop.ros2.action_goals import ActionGoal, GoalSequencer, GoalStep
from vla_zenoh.interop.ros2.gripper_actions import GRASP
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.names import get_result_of, request_of, response_of, send_goal_of
from vla_zenoh.interop.ros2.qos import COMMAND
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.profile.ros2 import GRIPPER_ACTIONS, Ros2Gripper
from vla_zenoh.robots.ros2.ros_graph import Caller, RosGraph
from vla_zenoh.types import Event, GripperCommand, Stamped

GIVE_UP_S = 5.0
"""A goal is given up when nothing is heard of it for so long beyond what its fingers need."""
ID_BYTES = 16


class Gripper:
    """Takes our gripper commands.

    Args:
        node: on whose behalf.
        link: to the ROS graph.
        messages: of the robot's distribution.
        profile: the gripper's section; None: this robot's gripper is not ours to command.
        width: how far its fingers are open (m), None where nobody says.
    """

    def __init__(
        self,
        node: Node,
        link: RosGraph,
        messages: Messages,
        profile: Ros2Gripper | None,
        width: Callable[[], float | None],
    ) -> None:
        self._node, self._messages, self._profile = node, messages, profile
        self._measured_m, self._sent_m = width, node.profile.robot.gripper.max_width_m
        self._orders = node.subscribe(node.keys.command_gripper, CallbackRing(16, SMALL_BYTES))
        self._guard = GripperGuard(node.profile.robot.gripper)
        self._keeper = GoalSequencer(GIVE_UP_S, node.profile.robot.gripper.max_width_m)
        self._news: deque[Callable[[], None]] = deque()
        self._goal_id = b""
        self._action = ""
        self._mono_ns = 0
        self._led_by = ""
        self.wanted_m: float | None = None
        self._held = False
        self._callers: dict[str, dict[str, Caller]] = {}
        self._topic = None
        if profile is None:
            return
        if profile.type in GRIPPER_ACTIONS:
            self._callers[profile.type] = link.call_action(profile.topic, profile.type)
            if profile.grasp is not None:
                self._callers[GRASP] = link.call_action(profile.grasp, GRASP)
        else:
            self._topic = link.write(profile.topic, profile.type, COMMAND)

    @property
    def busy(self) -> bool:
        """A goal is in flight."""
        return self._keeper.goal is not None

    @property
    def holding(self) -> bool:
        """Something is between the fingers.

        A Franka's grasp succeeds where ``width - inner < d < width + outer`` holds for the distance
        d of its fingers, and both tolerances are the whole stroke here, as nobody knows how thick
        the object is: so it succeeds on nothing, and who holds something is told by d.

        Source: documentation of franka_gripper, ``grasp``.
        """
        if self._action != GRASP or not self._held:
            return self._held
        at_m = self._measured_m()
        dead_band_m = self._node.profile.robot.gripper.dead_band_m
        return at_m is not None and at_m > self._sent_m + dead_band_m

    def turn(self, now_ns: int, writer: str, *, leads: bool) -> None:
        """Take commands and answers, and do what is due.

        Args:
            now_ns: on the wall clock, for stamps.
            writer: source whose commands the arm follows, empty while it follows nobody's.
            leads: that source carries out what it is told, see `ArmGuard.leads`.
        """
        self._mono_ns = time.monotonic_ns()
        if self._led_by and not leads:
            self._end_wish()
        self._led_by = writer if leads else ""
        while self._news:
            self._news.popleft()()
        for arrival in self._orders.drain():
            order = self._node.decode(GripperCommand, arrival)
            if order is not None:
                self._offer(order, now_ns, writer, leads=leads)
        step = self._keeper.step(self._mono_ns)
        self._node.counters["ros2.gripper_timeouts"] = self._keeper.timeouts
        goal = self._keeper.goal
        if step is GoalStep.SEND and goal is not None:
            self._send(goal)
        elif step is GoalStep.CANCEL and goal is not None:
            self._cancel()

    def _end_wish(self) -> None:
        """A stop, as any other end of a motion, ends what was asked for in it and not begun."""
        wish = self._keeper.forget()
        if wish is not None:
            self.wanted_m = self._sent_m
            why = f"to {wish.width_m:.3f} m waited when {self._led_by[:60]!r} stopped"
            self._node.reject("outlived", f"command/gripper {why}")

    def _offer(
        self, order: Stamped[GripperCommand], now_ns: int, writer: str, *, leads: bool
    ) -> None:
        try:
            command = self._guard.accept(order, writer, now_ns, writer_active=leads)
        except CodecError as error:
            self._node.reject(error.reason, f"command/gripper {error}")
            return
        self._node.counters["gripper_bounded"] = self._guard.bounded
        self._take(command, now_ns)

    def _take(self, command: GripperCommand, now_ns: int) -> None:
        if self._profile is None:
            self._node.reject("no_gripper", "command/gripper: the profile has no ros2.gripper")
            return
        self.wanted_m = command.width_m
        if self._topic is None:
            self._keeper.want(command)
            return
        message = _NUMBERS[self._profile.type](
            self._messages, self._profile.type, self._position(command), Stamp(now_ns, "")
        )
        self._topic.put(self._messages.encode(message))

    def _position(self, command: GripperCommand) -> float:
        assert self._profile is not None
        gripper = self._node.profile.robot.gripper
        return gripper_actions.position(self._profile, gripper, command.width_m)

    # -- the action ---------------------------------------------------------------------------
    def _send(self, goal: ActionGoal) -> None:
        assert self._profile is not None
        use_grasp = GRASP in self._callers and self._closes(goal.command.width_m)
        self._sent_m = goal.command.width_m
        self._action = GRASP if use_grasp else self._profile.type
        self._goal_id = secrets.token_bytes(ID_BYTES)
        self._held = False
        request = gripper_actions.send_goal(
            self._messages,
            self._action,
            self._goal_id,
            goal.command,
            position=self._position(goal.command),
            max_width_m=self._node.profile.robot.gripper.max_width_m,
        )
        self._node.counters["ros2.gripper_goals"] += 1
        self._call("send_goal", request, lambda answer: self._accepted(goal, answer))

    def _closes(self, width_m: float) -> bool:
        """Whether the fingers have to close for it; they are where they were sent last, at first
        wide open, where nobody says where they are."""
        measured_m = self._measured_m()
        at_m = self._sent_m if measured_m is None else measured_m
        return width_m < at_m - self._node.profile.robot.gripper.dead_band_m

    def _call(
        self,
        part: str,
        request: Any,
        done: Callable[[bytes | None], None],
        wait_s: float | None = None,
    ) -> None:
        # Answers come on Zenoh's thread; they are looked at in the next turn.
        self._callers[self._action][part].call(
            self._messages.encode(request),
            lambda answer: self._news.append(lambda: done(answer)),
            wait_s,
        )

    def _accepted(self, goal: ActionGoal, answer: bytes | None) -> None:
        response = self._read(response_of(send_goal_of(self._action)), answer)
        if response is None or not response.accepted:
            if self._keeper.ended(goal.number):
                self._complain("refused the goal" if response is not None else "does not answer")
            return
        self._keeper.accepted(goal.number, self._mono_ns)
        request = self._messages.new(
            request_of(get_result_of(self._action)),
            goal_id=gripper_actions.uuid(self._messages, self._goal_id),
        )
        # As long as the goal may take, and its end when it is cancelled then.
        wait_s = self._keeper.travel_s(goal) + 2 * GIVE_UP_S
        self._call("get_result", request, lambda answer: self._ended(goal.number, answer), wait_s)

    def _ended(self, number: int, answer: bytes | None) -> None:
        if not self._keeper.ended(number):
            return
        response = self._read(response_of(get_result_of(self._action)), answer)
        if response is None:
            self._complain("does not say how the goal ended")
            return
        outcome = gripper_actions.outcome(self._action, response)
        self._held = outcome.holding
        if not (outcome.reached or outcome.holding):
            self._complain(f"did not get there (status {response.status}) {outcome.message}")

    def _cancel(self) -> None:
        self._node.counters["ros2.gripper_cancelled"] += 1
        request = gripper_actions.cancel(self._messages, self._goal_id)
        self._call("cancel_goal", request, lambda _: None)  # the goal's result says the rest

    def _read(self, kind: str, answer: bytes | None) -> Any:
        if answer is None:
            return None
        try:
            return self._messages.decode(kind, answer)
        except CodecError as error:
            self._node.reject(error.reason, f"answer of {self._action}: {error}", self._action)
            return None

    def _complain(self, what: str) -> None:
        assert self._profile is not None
        where = self._profile.topic if self._action != GRASP else self._profile.grasp
        why = f"the gripper at {where or self._profile.topic} {what}"
        self._node.emit(Event("warning", "fault", "gripper", why[:1000]))


_NUMBERS: dict[str, table.Write] = {row.type: row.write for row in table.GRIPPER_WRITINGS}
