"""One goal of an action at a time, and the newest wish wins.

A wish that comes while a goal runs cancels it, and is sent when the robot says that it has ended:
never two goals at once, never a stop that overtakes the move it was meant for. A wish that waits
is forgotten when whoever asked for it leads the arm no more.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from vla_zenoh.types import GripperCommand


class GoalStep(Enum):
    """What is to be done now."""

    SEND = "send"
    CANCEL = "cancel"


class ActionGoal(NamedTuple):
    """A goal in flight, told apart by its number."""

    number: int
    command: GripperCommand


class GoalSequencer:
    """Decides when a goal is sent or cancelled. Time is given in ns of any clock.

    Args:
        timeout_s: a goal of which nothing is heard for so long is given up; one that the robot
            took has in addition the time that its fingers may need.
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
        """Ask for an opening; replaces every wish that was not sent."""
        self._wish = command

    def forget(self) -> GripperCommand | None:
        """Let the wish go that was not sent, and say which it was."""
        wish, self._wish = self._wish, None
        return wish

    def accepted(self, number: int, now_ns: int) -> None:
        """The robot took the goal."""
        if self.goal is not None and number == self.goal.number:
            self._accepted, self._since_ns = True, now_ns

    def ended(self, number: int) -> bool:
        """The goal was refused, or has ended in any way; False where it is an old one's end."""
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
