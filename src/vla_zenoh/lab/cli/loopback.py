"""Loopback addresses for commands of the lab: one of their own, and no port open to a network."""

from __future__ import annotations

import socket

import typer

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.output import errors
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.profile import Profile, SessionProfile, override
from vla_zenoh.profile.schema import is_loopback_address


def own_address(profile: Profile) -> Profile:
    """The profile at a loopback address where no router answers, so it never reaches a real robot.

    Raises:
        typer.BadParameter: the profile is of a real robot.
    """
    if profile.robot.driver != "sim":
        raise typer.BadParameter(
            f"profile {profile.name} is of a real robot; this needs a simulated one"
        )
    # It stays on this computer and needs no certificates.
    plain = {"security": None, "insecure": False, "separate_links": False}
    if profile.session.security is not None:
        local = list(SessionProfile().connect)
        profile = override(profile, {"session": {**plain, "connect": local, "listen": local}})
    try:
        open_session(profile.session).close()
        endpoints = (f"tcp/127.0.0.1:{free_port()}",)
        errors().print("a router already answers at the profile's address; using another port")
    except SessionError:
        endpoints = profile.session.connect
    here = list(endpoints)
    return override(profile, {"session": {**plain, "connect": here, "listen": here}})


def free_port() -> int:
    """A TCP port that nothing listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def require_loopback(
    profile: Profile, option: str, address: str, danger: str, instead: str
) -> None:
    """Reject a network address for a port that asks for no certificate.

    A profile with ``insecure: true`` has accepted that its network may do everything.

    Args:
        address: to listen at, without a port.

    Raises:
        SecurityError: the address is not a loopback address.
    """
    if is_loopback_address(address) or profile.session.insecure:
        return
    if profile.session.security is None:
        instead += f", or set session.insecure: true in profile {profile.name}"
    raise SecurityError(
        f"{option} {address or '(all interfaces)'} lets anyone on that network {danger}: {instead}"
    )
