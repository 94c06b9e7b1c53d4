"""vla-zenoh prompt."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import DEFAULT_PROFILE, ConnectOption, ProfileOption, client
from vla_zenoh.cli.output import console


def prompt(
    text: Annotated[str, typer.Argument(help="What the model is asked to do.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
) -> None:
    """Put a prompt. The same from any Zenoh client: put the text on <root>/<robot>/prompt."""
    with client(profile, connect) as robot:
        task = robot.set_prompt(text)
        console().print(f"prompt: {task.prompt!r} (worker {task.worker}, {task.rate_hz:g} Hz)")
