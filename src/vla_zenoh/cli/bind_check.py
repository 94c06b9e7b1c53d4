"""Ports that we open beside Zenoh, for which no certificate of the lab is asked."""

from __future__ import annotations

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import Profile
from vla_zenoh.profile.session import is_loopback_address


def refuse_beyond_here(
    profile: Profile, option: str, address: str, danger: str, instead: str
) -> None:
    """Whoever reaches such a port is let in, so it is opened on this computer alone.

    A profile that says ``insecure: true`` has said that its network may do everything.

    Args:
        profile: the effective one.
        option: that names the address.
        address: to listen at, without a port.
        danger: what everybody on that network could do.
        instead: what to do.

    Raises:
        SecurityError: the address is one of a network.
    """
    if is_loopback_address(address) or profile.session.insecure:
        return
    if profile.session.security is None:
        instead += f", or have profile {profile.name} say session.insecure: true"
    raise SecurityError(
        f"{option} {address or '(everywhere)'} lets everybody on that network {danger}: {instead}"
    )
