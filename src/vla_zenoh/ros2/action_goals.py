"""Sequences the goals of a ROS 2 action: one at a time, the newest request wins.

A request during a goal cancels it, and is sent once the robot has ended it: never two goals at
once, never a stop that overtakes its move. A waiting request is dropped when its writer no longer
controls the arm.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from vla_zenoh.types import GripperCommand


class GoalStep(Enum):
    """Next action of the sequencer."""

    SEND = "send"
    CANCEL = "cancel"


class ActionGoal(NamedTuple):
    """A goal in flight, identified by its number."""

    number: int
    command: GripperCommand


class GoalSequencer:
    """Decides when a goal is sent or cancelled. Time is given in ns of any clock.

    Args:
        timeout_s: a goal without any response is abandoned after this; an accepted one has in
            addition the travel time of the fingers.
        stroke_m: the longest way of the fingers, which they go at the speed of the goal.
    """

    def __init__(self, timeout_s: float, stroke_m: float) -> None:
        self._timeout_ns, self._stroke_m = int(timeout_s * 1e9), stroke_m
        self._wish: GripperCommand | None = None
        self._accepted = self._cancelling = False
        self._since_ns = 0
        self._number = 0
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
