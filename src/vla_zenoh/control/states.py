"""The state machine of the command node, as a table of all transitions.

INACTIVE   stands and executes nothing
ACTIVE     executes chunks
HOLDING    no fresh chunk: brakes, stands, resumes with the next fresh chunk
STOPPED    emergency stop, latched until reset
FAULT      fault of the robot or the command node, latched until reset
"""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of the command node; the values are wire names."""

    INACTIVE = "inactive"
    ACTIVE = "active"
    HOLDING = "holding"
    STOPPED = "stopped"
    FAULT = "fault"


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

OBEYING = frozenset({State.ACTIVE, State.HOLDING})
"""States in which chunks of the leased worker are executed."""


DEACTIVATED = "deactivated"
"""The reason of an INACTIVE state that a client requested."""


def after(state: State, trigger: Trigger) -> State:
    """The state after `trigger`; unchanged if the table has no such transition."""
    return TABLE.get((state, trigger), state)
