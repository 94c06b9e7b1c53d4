"""vla-zenoh teleop."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated, Literal

import typer
import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import DEFAULT_PROFILE, ConnectOption, HostOption, ProfileOption
from vla_zenoh.cli.output import errors
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import SecurityError
from vla_zenoh.keys import worker_node
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import run_node


def teleop(
    device: Annotated[
        Literal["keyboard", "gamepad", "spacemouse"],
        typer.Option("--device", "-d", help="Sticks beside the keyboard, which always works."),
    ] = "keyboard",
    frame: Annotated[
        Literal["base", "tcp"], typer.Option(help="Axes of the motion: the robot's or the tool's.")
    ] = "base",
    speed: Annotated[int, typer.Option("--speed", min=1, max=5, help="Level at first.")] = 3,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    name: Annotated[str, typer.Option("--name", help="What the worker is called.")] = "teleop",
) -> None:
    """Drive the arm by hand: a worker like any other, whose model is you.

    `vla-zenoh use teleop` (or Tab) gives it the arm, also while a model moves it; what you do is
    recorded as a model's run would be.
    """
    from vla_zenoh.lab.teleop.node import Teleop
    from vla_zenoh.lab.teleop.sticks import DEVICES

    loaded = RobotTarget(profile, connect, host).load()
    with ExitStack() as stack:
        stick = DEVICES[device]() if device in DEVICES else None
        if stick is not None:
            stack.callback(stick.close)
            errors().print(f"{stick.name} is used beside the keyboard")

        def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
            people = _people(loaded, stack)
            Teleop(loaded, session, people, name, device=stick, frame=frame, level=speed - 1).run(
                stop
            )

        run_node(loaded, run, identity=worker_node(name))


def _people(profile: Profile, stack: ExitStack) -> zenoh.Session | None:
    """A session with the rights of whoever sits here: a worker may not put settings."""
    try:
        return stack.enter_context(open_session(profile.session))
    except SecurityError as error:
        errors().print(f"enter, tab and x will do nothing: {error}", style="yellow")
        return None
