"""The arm obeys while a program of a person runs: `vla-zenoh activate --hold`."""

from __future__ import annotations

import threading

import typer

from vla_zenoh.bus.client import Client
from vla_zenoh.cli.output import console, fail
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.types import Task

LOOK_S = 0.05
STAND_PATIENCE_S = 3.0


def hold(aim: RobotTarget, client: Client, given: Task, stop: threading.Event) -> None:
    """Stay until the arm obeys no more. Ctrl-C brakes it first.

    Args:
        aim: as typed.
        client: holds it active, see `Client.activate_with_deadman`.
        given: the task it was activated with.
        stop: set by Ctrl-C.
    """
    console().print("It obeys while this runs: Ctrl-C brakes it, and so does whatever ends this.")
    while not stop.wait(LOOK_S):
        if why := over(client, given):
            fail(f"the arm obeys no more: {why}; {aim.named(client)}")
    if not client.deactivate(STAND_PATIENCE_S):
        fail(
            f"the command node of {aim.named(client)} does not say that the arm stands; look at "
            f"`{aim.typed('status')}`"
        )
    console().print(f"inactive, the arm stands: {aim.named(client)}", soft_wrap=True)
    raise typer.Exit(130)


def over(client: Client, given: Task) -> str:
    """Why the arm obeys no more since it was activated with `given`, empty while it does."""
    if "command" not in client.alive:
        return "its command node is not heard"
    status = client.status("command")
    if status is None or status.state in ("active", "holding"):
        return ""
    episode = status.detail.get("episode")
    if not isinstance(episode, int) or episode < given.episode:  # said before it was activated
        return ""
    return str(status.detail.get("why", "")) or status.state
