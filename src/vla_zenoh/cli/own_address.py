"""A profile at an address of its own: what is only tried must never reach a lab's real robot."""

from __future__ import annotations

import socket

import typer

from vla_zenoh.cli.output import errors
from vla_zenoh.errors import SessionError
from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import Profile, SessionProfile, override


def own_address(profile: Profile) -> Profile:
    """The profile where nobody answers.

    Raises:
        BadParameter: it is of a real robot.
    """
    if profile.robot.driver != "sim":
        raise typer.BadParameter(f"profile {profile.name} is of a real robot; demos are simulated")
    # It stays on this computer, and needs no certificates.
    plain = {"security": None, "insecure": False, "separate_links": False}
    if profile.session.security is not None:
        local = list(SessionProfile().connect)
        profile = override(profile, {"session": {**plain, "connect": local, "listen": local}})
    try:
        open_session(profile.session).close()
        port = _free_port()
        endpoints = (f"tcp/127.0.0.1:{port}",)
        errors().print("a router answers at the profile's address already; using another port")
    except SessionError:
        endpoints = profile.session.connect
    here = list(endpoints)
    return override(profile, {"session": {**plain, "connect": here, "listen": here}})


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
