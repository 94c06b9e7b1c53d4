"""What to ask of a franka-node next, and what its state means for us: no Zenoh, no clock."""

from __future__ import annotations

from vla_zenoh_franka_node.wire import State

BUSY = frozenset({"active", "homing", "stopping"})
"""Phases in which the node recovers nothing."""
STOPPED = {
    "reflex": "Reflex: a collision or a limit stopped the arm",
    "user_stopped": "UserStopped: the user stop or the enabling device stopped the arm",
}
"""Robot modes that are a fault."""
READY = frozenset({"idle", "move"})


def next_verb(state: State, client_id: int, *, wanted: bool, recovering: bool) -> str:
    """The verb that brings `client_id` nearer to a session, or to its end; empty: none does.

    Args:
        state: newest of the node.
        client_id: ours.
        wanted: the session should run.
        recovering: an operator asked to clear errors.
    """
    if recovering and state.phase not in BUSY and is_stopped(state):
        return "recover"
    if state.holder != client_id:
        return "acquire" if state.holder == 0 and state.phase == "idle" else ""
    if wanted and state.phase in ("idle", "acquired") and state.robot_mode in READY:
        return "enable"
    return "stop" if state.phase == "active" and not wanted else ""


def is_stopped(state: State) -> bool:
    """The robot needs ``recover`` before it moves again."""
    return state.phase == "faulted" or state.robot_mode in STOPPED


def fault_of(state: State) -> str:
    """Why the robot does not move; empty: no fault."""
    if state.robot_mode in STOPPED:
        return STOPPED[state.robot_mode]
    if state.phase == "faulted":
        return (
            f"franka-node's loop ended with an error (robot mode {state.robot_mode}); see its log"
        )
    return ""


def mode_of(state: State, client_id: int, refusal: str) -> str:
    """Why a healthy robot does not follow us; empty: it does.

    Args:
        state: newest of the node.
        client_id: ours.
        refusal: what the node said to our last verb.
    """
    if state.holder not in (0, client_id):
        return f"client {state.holder} of franka-node has the lease"
    if state.robot_mode not in READY:
        return state.robot_mode
    if state.phase == "active" and state.holder == client_id:
        return ""
    return refusal or f"franka-node is {state.phase}"
