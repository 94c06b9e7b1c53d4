"""vla-zenoh activate, deactivate, use, rate, stop, reset: one put each."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import DEFAULT_PROFILE, ConnectOption, ProfileOption, client
from vla_zenoh.cli.output import console, fail, styled

STOP_PATIENCE_S = 3.0


def activate(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Give the arm to the worker. Refused with every reason while something is not right."""
    with client(profile, connect) as robot:
        task = robot.activate()
        console().print(
            f"active: worker {task.worker}, prompt {task.prompt!r}, {task.rate_hz:g} Hz"
        )


def deactivate(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Brake, and obey nobody."""
    with client(profile, connect) as robot:
        if not robot.deactivate(STOP_PATIENCE_S):
            fail("the command node does not say that the arm stands; look at `vla-zenoh status`")
        console().print("inactive, the arm stands")


def use(
    worker: Annotated[str, typer.Argument(help="Worker whose chunks are to be obeyed.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
) -> None:
    """Choose the worker that is obeyed; the others go on beside it."""
    with client(profile, connect) as robot:
        task = robot.set_worker(worker)
        console().print(f"worker: {task.worker}")


def rate(
    rate_hz: Annotated[float, typer.Argument(help="Chunks per second.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
) -> None:
    """Choose how often the workers infer."""
    with client(profile, connect) as robot:
        task = robot.set_rate(rate_hz)
        console().print(f"rate: {task.rate_hz:g} Hz")


def stop(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Emergency stop: brake now, and stay stopped until `vla-zenoh reset`."""
    with client(profile, connect) as robot:
        robot.put(robot.keys.stop, "stop")

        def stopped() -> bool:
            status = robot.status("command")
            return status is not None and status.state == "stopped"

        if not robot.wait_for(stopped, STOP_PATIENCE_S):
            fail("no command node says that it stopped; look at `vla-zenoh status`")
        console().print(styled("stopped", "bold red"), "`vla-zenoh reset` clears it", sep="; ")


def reset(profile: ProfileOption = DEFAULT_PROFILE, connect: ConnectOption = None) -> None:
    """Clear an emergency stop or a fault. The arm stays inactive."""
    with client(profile, connect) as robot:
        robot.put(robot.keys.reset, "reset")

        def cleared() -> bool:
            status = robot.status("command")
            return status is not None and status.state not in ("stopped", "fault")

        if not robot.wait_for(cleared, STOP_PATIENCE_S):
            status = robot.status("command")
            fail(f"not cleared: {status.detail.get('why', '') if status else 'no command node'}")
        console().print("reset; inactive")
