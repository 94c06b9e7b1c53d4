"""The host on which a node runs."""

from __future__ import annotations

import os
import socket
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_zenoh.keys import key_chunk

if TYPE_CHECKING:
    from vla_zenoh.profile import SessionProfile

HOST_VARIABLE = "VLA_ZENOH_HOST"
"""Name of this host in the profile, unless an option gives it."""
BOOT_FILE = Path("/proc/sys/kernel/random/boot_id")


class HostId(NamedTuple):
    """Host on which a node runs."""

    host: str
    """Name in the profile if known, else the computer's own name, which need not be unique."""
    boot: str
    """Unique id of this boot; empty if the system has none."""

    def shares_clock(self, other: HostId) -> bool:
        """Whether both certainly run on the same computer; False if unknown."""
        return bool(self.boot) and self == other


def own_host_id(session: SessionProfile, host: str | None = None) -> HostId:
    """Identity of this host; `host` is given by an option, a secured one named by its certificates.

    Raises:
        ProfileError: the name cannot be part of a key.
    """
    security = session.security
    named = host or (security.host if security else None) or os.environ.get(HOST_VARIABLE)
    if not named and security is not None:
        from vla_zenoh.security.store import Store

        named = Store(security.folder).known_host()
    return HostId(key_chunk(named, "host") if named else socket.gethostname(), own_boot_id())


@cache
def own_boot_id() -> str:
    """Id of this boot; empty if the system has none."""
    try:
        return BOOT_FILE.read_text("ascii").strip()
    except OSError:
        return ""
