"""Options that many commands share, and the profile they lead to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from vla_zenoh.nodes.client import Client
from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import Profile, load_profile, override

DEFAULT_PROFILE = "panda_sim"

ProfileOption = Annotated[
    str,
    typer.Option("--profile", "-p", envvar="VLA_ZENOH_PROFILE", help="Name or path of a profile."),
]
ConnectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        "-e",
        envvar="VLA_ZENOH_CONNECT",
        help="Router to connect to, as tcp/HOST:PORT; may be given more than once.",
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        "-l",
        envvar="VLA_ZENOH_LISTEN",
        help="Where the router listens, as tcp/HOST:PORT; may be given more than once.",
    ),
]
HostOption = Annotated[
    str | None, typer.Option("--host", help="Which host of the profile this computer is.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for a script.")]


def effective_profile(
    name: str, connect: list[str] | None = None, listen: list[str] | None = None
) -> Profile:
    """The profile, with endpoints from the command line in place of its own.

    Raises:
        ProfileError: it is wrong.
    """
    profile = load_profile(name)
    changes: dict[str, list[str]] = {}
    if connect:
        changes["connect"] = connect
    if listen:
        changes["listen"] = listen
    return override(profile, {"session": changes}) if changes else profile


@contextmanager
def client(profile_name: str, connect: list[str] | None) -> Iterator[Client]:
    """A connected client that already hears the nodes.

    Raises:
        SessionError: no router answers.
    """
    profile = effective_profile(profile_name, connect)
    with open_session(profile.session) as session:
        yield Client(profile, session).follow()
