"""Whose certificate a person at this computer shows, where there are those of several hosts.

Who can read a private key has its rights already: to choose among those that lie here gives nobody
more than `--host` would. So the choice is made for convenience alone, and never stands in the way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vla_zenoh.errors import SecurityError
from vla_zenoh.security.identity import PEOPLE, Role, operator_role

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile

RANK = {Role.OPERATOR: 0, Role.VIEWER: 1}
"""The role that replays recordings is chosen by name only: it may publish on every key."""


def operator_hosts(profile: Profile, *, stop: bool = False) -> list[str]:
    """Hosts whose operator certificates lie here, the one to use first.

    Args:
        profile: secured. Hosts that it does not know are left out: the router would drop what they
            say without a word.
        stop: for a stop one who may comes first, also before this computer's own people.

    Returns:
        This computer's own host first where it is known, then operators before viewers, in the
        order of the profile, where hosts stand before people, who are sooner taken out of it. But
        for a stop, only that which ``session.security.host`` names, if it names one. Empty where
        no operator certificate lies here.
    """
    security = profile.session.security
    if security is None:
        return []
    if security.host is not None and not stop:
        return [security.host]
    from vla_zenoh.security.store import Store

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
    """Role of the people at this computer; None: unrestricted, or unknown."""
    security = profile.session.security
    if security is None:
        return None
    from vla_zenoh.security.store import Store

    try:
        files = Store(security.folder).identity_files(security.host, None, security.people)
    except SecurityError:
        return None
    return next((role for role in PEOPLE if role.value == files.certificate.stem), None)
