"""vla-zenoh prompt."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    ProfileOption,
    RobotOption,
)
from vla_zenoh.cli.output import console
from vla_zenoh.cli.target import RobotTarget


def prompt(
    text: Annotated[str, typer.Argument(help="What the model is asked to do.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Put a prompt. The same from any Zenoh client: put the text on <root>/<robot>/prompt."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.driver("prompt", text) as client:
        task = client.set_prompt(text)
        console().print(
            f"prompt: {task.prompt!r} (worker {task.worker}, {task.rate_hz:g} Hz), "
            f"{aim.named(client)}",
            soft_wrap=True,
        )
