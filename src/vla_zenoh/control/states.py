"""The command node's state machine, as a table. Everything that changes the state is in this file.

INACTIVE   stands, obeys nobody
ACTIVE     carries out chunks
HOLDING    nothing fresh came: brakes, stands, goes on with the next fresh chunk
STOPPED    emergency stop, latched until reset
FAULT      the robot or the command node itself reports a fault, latched until reset
"""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """See the module."""

    INACTIVE = "inactive"
    ACTIVE = "active"
    HOLDING = "holding"
    STOPPED = "stopped"
    FAULT = "fault"


class Trigger(StrEnum):
    """What can happen."""

    ACTIVATE = "activate"  # asked for, and preflight found nothing
    DEACTIVATE = "deactivate"
    FRESH = "fresh"  # a chunk was accepted
    STARVE = "starve"  # no fresh chunk within the watchdog
    LOSE = "lose"  # robot, worker or camera gone, or the arm is blocked
    STOP = "stop"
    FAULT = "fault"
    RESET = "reset"  # asked for, and no fault is left


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
"""States in which a chunk of the leased worker is carried out."""


DEACTIVATED = "deactivated"
"""Why it is inactive when somebody said so."""


def after(state: State, trigger: Trigger) -> State:
    """The state after `trigger`; unchanged where the table has no edge."""
    return TABLE.get((state, trigger), state)
