"""Addresses of this computer: a profile at one of its own, and which are."""

from __future__ import annotations

import ipaddress
import socket
from typing import Any

import typer

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.output import errors
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import Profile, SessionProfile, override


def is_own(address: str) -> bool:
    """Whether `address`, or what that name means, is this computer's."""
    try:
        found = socket.getaddrinfo(address, 0, type=socket.SOCK_DGRAM)
    except OSError:
        return False
    return any(_can_bind(family, place) for family, _, _, _, place in found)


def _can_bind(family: int, place: tuple[Any, ...]) -> bool:
    if ipaddress.ip_address(str(place[0]).partition("%")[0]).is_unspecified:
        return False  # is everybody's
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(place)
        except OSError:
            return False
    return True


def own_address(profile: Profile) -> Profile:
    """The profile where nobody answers: what is only tried must never reach a lab's real robot.

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
