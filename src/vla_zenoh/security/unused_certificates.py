"""Certificates that are good, and of no use: the profile does not know whose they are."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from vla_zenoh.profile import Profile
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.identity import identities
from vla_zenoh.security.store import Entry


def unused_certificates(profile: Profile, entries: Iterable[Entry]) -> dict[Path, str]:
    """Those whose owner says what he likes: the router drops it. File -> what to do.

    So it is after people at a computer were given less, or a node was taken away.

    Args:
        profile: secured.
        entries: of its folder.

    Raises:
        SecurityError: a kind of node has no role.
    """
    security = profile.session.security
    people = security.people if security is not None else {}
    known = {one.common_name for one in (*identities(profile), *bridges(profile))}
    out: dict[Path, str] = {}
    for entry in entries:
        if entry.host and f"{entry.node}@{entry.host}" not in known:
            role = people.get(entry.host)
            given = f", where people at {entry.host} are {role}" if role is not None else ""
            out[entry.path] = (
                f"is not known to profile {profile.name}{given}: delete it here and on {entry.host}"
            )
    return out
