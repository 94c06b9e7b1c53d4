"""Which host this is, and which start of which computer, for status."""

from __future__ import annotations

import os
import socket
from functools import cache
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.keys import key_chunk
from vla_zenoh.profile import SessionProfile
from vla_zenoh.security.store import Store

HOST_VARIABLE = "VLA_ZENOH_HOST"
"""Which host of the profile this computer is, where no option says it."""
BOOT_FILE = Path("/proc/sys/kernel/random/boot_id")


class HostId(NamedTuple):
    """Where a node runs.

    Args:
        host: of the profile, where it is known; else the computer's own name, which several may
            have.
        boot: drawn anew at every start of the computer, so that no other one has it; empty where
            the system tells none.
    """

    host: str
    boot: str

    def shares_clock(self, other: HostId) -> bool:
        """Whether both certainly run on the same computer. Unknown is not the same."""
        return bool(self.boot) and self == other


def own_host_id(session: SessionProfile, host: str | None = None) -> HostId:
    """Where this process runs.

    Args:
        session: of the profile; with certificates, whose they are here.
        host: of the profile, where somebody said so.

    Raises:
        ProfileError: what was said cannot be a host's name.
    """
    security = session.security
    named = host or (security.host if security else None) or os.environ.get(HOST_VARIABLE)
    if not named and security is not None:
        named = Store(security.folder).known_host()
    return HostId(key_chunk(named, "host") if named else socket.gethostname(), own_boot_id())


@cache
def own_boot_id() -> str:
    """The start of this computer; empty on systems that tell none."""
    try:
        return BOOT_FILE.read_text("ascii").strip()
    except OSError:
        return ""
