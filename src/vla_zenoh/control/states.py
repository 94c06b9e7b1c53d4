"""States of the command node, and what the motion may do in each of them, as tables.

Every change of the state goes by `TABLE`. `motion_pipeline.py` chooses the mode of a motion; the
tests hold it to `MODES` in every tick.
"""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of the command node; the values are wire names."""

    INACTIVE = "inactive"  # stands and executes nothing
    ACTIVE = "active"  # executes chunks
    HOLDING = "holding"  # no fresh chunk: brakes, stands, resumes with the next fresh chunk
    STOPPED = "stopped"  # emergency stop, latched until reset
    FAULT = "fault"  # of the robot or the command node, latched until reset

    def after(self, trigger: Trigger) -> State:
        """The state after `trigger`; unchanged if `TABLE` has no such transition."""
        return TABLE.get((self, trigger), self)


class Trigger(StrEnum):
    """Events that may change the state."""

    ACTIVATE = "activate"  # requested, and preflight found no reason against it
    DEACTIVATE = "deactivate"
    FRESH = "fresh"  # a chunk came into force
    STARVE = "starve"  # no fresh chunk within the watchdog
    LOSE = "lose"  # robot, worker or camera gone, or the arm is blocked
    STOP = "stop"
    FAULT = "fault"
    RESET = "reset"  # requested, and no fault is left


TABLE: dict[tuple[State, Trigger], State] = {
    (State.INACTIVE, Trigger.ACTIVATE): State.ACTIVE,
    (State.INACTIVE, Trigger.STOP): State.STOPPED,
    (State.INACTIVE, Trigger.FAULT): State.FAULT,
    (State.ACTIVE, Trigger.DEACTIVATE): State.INACTIVE,
    (State.ACTIVE, Trigger.STARVE): State.HOLDING,
    (State.ACTIVE, Trigger.LOSE): State.INACTIVE,
    (State.ACTIVE, Trigger.STOP): State.STOPPED,
    (State.ACTIVE, Trigger.FAULT): State.FAULT,
    (State.HOLDING, Trigger.FRESH): State.ACTIVE,
    (State.HOLDING, Trigger.DEACTIVATE): State.INACTIVE,
    (State.HOLDING, Trigger.LOSE): State.INACTIVE,
    (State.HOLDING, Trigger.STOP): State.STOPPED,
    (State.HOLDING, Trigger.FAULT): State.FAULT,
    (State.STOPPED, Trigger.RESET): State.INACTIVE,
    (State.FAULT, Trigger.RESET): State.INACTIVE,
    (State.FAULT, Trigger.STOP): State.STOPPED,
}
"""All transitions of the command node."""


class MotionMode(StrEnum):
    """What the motion of a part does in a tick: one of `MODES` of the node's state."""

    FOLLOW = "follow"  # moves to the goal in force
    PAUSE = "pause"  # stops on its path and goes on from there: speed 0, or another part is near
    CHANGE = "change"  # comes to rest, to go on in the space of the goals in force
    RETREAT = "retreat"  # moves back from what blocked it
    BRAKE = "brake"  # comes to rest and stays there


MODES: dict[State, frozenset[MotionMode]] = {
    State.ACTIVE: frozenset({MotionMode.FOLLOW, MotionMode.PAUSE, MotionMode.CHANGE}),
    State.HOLDING: frozenset({MotionMode.BRAKE}),
    State.INACTIVE: frozenset({MotionMode.RETREAT, MotionMode.BRAKE}),
    State.STOPPED: frozenset({MotionMode.BRAKE}),
    State.FAULT: frozenset({MotionMode.BRAKE}),
}
"""Modes of motion in each state of the command node."""
STOPPING = frozenset({MotionMode.PAUSE, MotionMode.CHANGE, MotionMode.BRAKE})
"""Modes in which the arm comes to rest."""
OBEYING = frozenset({State.ACTIVE, State.HOLDING})
"""States in which chunks of the leased worker are executed."""
DEACTIVATED = "deactivated"
"""The reason of an INACTIVE state that a client requested."""
