"""Valid certificates that the profile no longer authorises."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from vla_zenoh.profile import Profile
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.identity import identities

if TYPE_CHECKING:
    from vla_zenoh.security.lab_certificates import Entry


def unused_certificates(profile: Profile, entries: Iterable[Entry]) -> dict[Path, str]:
    """Certificates whose traffic the router drops: file -> what to do.

    There are some after a role was reduced or a node was removed from the profile.

    Args:
        profile: secured.
        entries: of its folder.
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
