"""Chooses the certificate that an operator at this computer uses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vla_zenoh.errors import SecurityError
from vla_zenoh.security.identity import PEOPLE, Role, operator_role
from vla_zenoh.security.store import Store

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile

RANK = {Role.OPERATOR: 0, Role.VIEWER: 1}
"""The role that replays recordings is chosen by name only: it may publish on every key."""


def operator_hosts(profile: Profile, *, stop: bool = False) -> list[str]:
    """Hosts whose operator certificates are on this computer, the preferred one first.

    Args:
        profile: secured. Hosts that it does not know are left out: the router would silently drop
            their messages.
        stop: prefer an operator to this computer's own host: a viewer may not stop the arm.

    Returns:
        This computer's own host first if it is known, then operators before viewers, in the order
        of the profile, hosts before people. Only ``session.security.host`` if it is set, except
        for a stop. Empty if there is no operator certificate.
    """
    security = profile.session.security
    if security is None:
        return []
    if security.host is not None and not stop:
        return [security.host]
    store = Store(security.folder)
    own = security.host or store.known_host()
    ranks: dict[str, int] = {}
    for host in dict.fromkeys([*profile.hosts, *security.people]):
        role = operator_role(profile, host)
        if role in RANK and store.has(host, role.value):
            ranks[host] = RANK[role]
    if stop:
        found = sorted(ranks, key=lambda host: (ranks[host], host != own))
    else:
        found = sorted(ranks, key=lambda host: (host != own, ranks[host]))
    return found or ([own] if own is not None else [])


def local_role(profile: Profile) -> Role | None:
    """Role of the operator at this computer; None: unrestricted, or unknown."""
    security = profile.session.security
    if security is None:
        return None
    try:
        files = Store(security.folder).identity_files(security.host, None, security.people)
    except SecurityError:
        return None
    return next((role for role in PEOPLE if role.value == files.certificate.stem), None)
