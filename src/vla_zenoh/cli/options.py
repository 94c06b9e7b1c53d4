"""Options that many commands share, and the profile they lead to."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from vla_zenoh.bus.host_id import HOST_VARIABLE
from vla_zenoh.profile import Profile, load_profile, override

DEFAULT_PROFILE = "panda_sim"
PROFILE_VARIABLE = "VLA_ZENOH_PROFILE"

ProfileOption = Annotated[
    str,
    typer.Option("--profile", "-p", envvar=PROFILE_VARIABLE, help="Name or path of a profile."),
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
    str | None,
    typer.Option(
        "--host", envvar=HOST_VARIABLE, help="Which host of the profile this computer is."
    ),
]
RobotOption = Annotated[
    str | None,
    typer.Option("--robot", help="Another robot at the same router than that of the profile."),
]
AlsoOption = Annotated[
    list[str] | None,
    typer.Option(
        "--also", help="Profile of another robot that the router serves; may be given repeatedly."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for a script.")]


def model_options(given: list[str]) -> dict[str, str]:
    """``name=value`` texts as a map.

    Raises:
        typer.BadParameter: one is not of this form.
    """
    out: dict[str, str] = {}
    for option in given:
        key, equals, value = option.partition("=")
        if not equals or not key.isidentifier():
            raise typer.BadParameter(f"--set wants name=value, not {option!r}")
        out[key] = value
    return out


def effective_profile(
    name: str,
    connect: list[str] | None = None,
    listen: list[str] | None = None,
    host: str | None = None,
) -> Profile:
    """The profile, with endpoints from the command line in place of its own.

    Args:
        name: of the profile, or its path.
        connect: in place of session.connect.
        listen: in place of session.listen.
        host: which of the profile's hosts this computer is; decides whose certificates are used.

    Raises:
        ProfileError: it is wrong.
    """
    profile = load_profile(name)
    changes: dict[str, Any] = {}
    if host is not None and profile.session.security is not None:
        changes["security"] = {"host": host}
    if connect:
        changes["connect"] = connect
    if listen:
        changes["listen"] = listen
    return override(profile, {"session": changes}) if changes else profile


def number_list(option: str, text: str, low: float, high: float) -> list[float]:
    """Numbers separated by commas.

    Raises:
        BadParameter: not numbers, or out of bounds; names the option.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"{option} wants numbers separated by commas: {error}") from error
    if not all(low <= number <= high for number in numbers):
        raise typer.BadParameter(f"{option} wants numbers from {low:g} to {high:g}")
    return numbers
