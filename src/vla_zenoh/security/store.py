"""Folder of a lab's certificates, as the nodes and operators of a host use it.

::

    FOLDER/ca.pem, ca.key         authority; its key never leaves this computer
    FOLDER/HOST/ca.pem            copy FOLDER/HOST to that host, into its own FOLDER
    FOLDER/HOST/NODE.pem, .key    certificate and key of each node and operator of the host
    FOLDER/HOST/names.json        names that changed, see `names`
    FOLDER/.this_host             name of the HOST that this computer is; not copied

Private keys are readable by their owner only. `certificates` checks, and
The package vla-zenoh-secure makes them.
"""

from __future__ import annotations

import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_zenoh.errors import SecurityError
from vla_zenoh.security.roles import PEOPLE, Role, operator_role

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile
    from vla_zenoh.profile.stop_profile import StopProfile

AUTHORITY = "ca"
THIS_HOST = ".this_host"


class Files(NamedTuple):
    """The files of one identity."""

    authority: Path
    certificate: Path
    key: Path


class Store:
    """Folder of a lab's certificates and keys; its path may begin with ``~``."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()

    def files(self, host: str, node: str) -> Files:
        """Paths of the files of an identity."""
        folder = self.folder / host
        return Files(folder / f"{AUTHORITY}.pem", folder / f"{node}.pem", folder / f"{node}.key")

    def this_host(self, host: str | None) -> str:
        """Host that this computer is: `host`, or `known_host`.

        Raises:
            SecurityError: there are no certificates, or those of several hosts.
        """
        if found := host or self.known_host():
            return found
        hosts = self.hosts()
        if not hosts:
            raise SecurityError(
                f"{self.folder} has no certificates: make them with `vla-zenoh secure init`, or "
                "copy this host's folder from the computer where that was done"
            )
        raise SecurityError(
            f"{self.folder} has certificates of {', '.join(hosts)}: say which of them this "
            "computer is, with --host or VLA_ZENOH_HOST"
        )

    def known_host(self) -> str | None:
        """The host that was noted, or the only one there are certificates for; None: unknown."""
        hosts = self.hosts()
        with suppress(OSError, UnicodeDecodeError):
            noted = (self.folder / THIS_HOST).read_text("utf-8").strip()
            if noted in hosts:
                return noted
        return hosts[0] if len(hosts) == 1 else None

    def hosts(self) -> list[str]:
        """Hosts that have certificates here."""
        return sorted(path.parent.name for path in self.folder.glob(f"*/{AUTHORITY}.pem"))

    def has(self, host: str, node: str) -> bool:
        """Whether certificate and key of a node exist."""
        files = self.files(host, node)
        return files.certificate.exists() and files.key.exists()

    def identity_files(
        self, host: str | None, node: str | None, people: Mapping[str, str] | None = None
    ) -> Files:
        """Files of a node of this computer, or of its operator if `node` is None.

        Where `people`, which is ``session.security.people``, names the host, only the certificate
        of that role is used: the router drops messages of others.

        Raises:
            SecurityError: they are missing, or others can read the key.
        """
        host = self.this_host(host)
        name = node or (people or {}).get(host)
        names = [name] if name else [role.value for role in PEOPLE]
        for name in names:
            if self.has(host, name):
                files = self.files(host, name)
                if fault := open_to_others(files.key):
                    raise SecurityError(fault)
                return files
        there = "" if host in self.hosts() else f" Here are those of: {', '.join(self.hosts())}."
        raise SecurityError(
            f"{self.files(host, names[0]).certificate} is not there.{there} Make it with "
            f"`vla-zenoh secure add {host}` on the computer of `secure init`, then copy the folder "
            f"{host}"
        )


def open_to_others(key: Path) -> str:
    """Sentence about a private key that other users can read; empty if none can."""
    mode = stat.S_IMODE(key.stat().st_mode)
    if mode & 0o077:
        return f"{key} can be read by others (mode {mode:o}): chmod 600 {key}"
    return ""


def operator_hosts(profile: Profile | StopProfile, *, stop: bool = False) -> list[str]:
    """Hosts whose operator certificates are on this computer, the preferred one first.

    This computer's own host if it is known, then operators before viewers, in the order of the
    profile, hosts before people; for a `stop` operators before the own host, as a viewer may not
    stop the arm. Only ``session.security.host`` if it is set, except for a stop. Hosts that the
    profile does not know are left out: the router would silently drop their messages. So are those
    of a replay, which is chosen by name only: it may publish on every key.
    """
    security = profile.session.security
    if security is None:
        return []
    if security.host is not None and not stop:
        return [security.host]
    store = Store(security.folder)
    own = security.host or store.known_host()
    ranks: dict[str, tuple[bool, bool]] = {}
    for host in dict.fromkeys([*profile.hosts, *security.people]):
        role = operator_role(profile, host)
        if role in (Role.OPERATOR, Role.VIEWER) and store.has(host, role.value):
            elsewhere, watches = host != own, role is Role.VIEWER
            ranks[host] = (watches, elsewhere) if stop else (elsewhere, watches)
    return sorted(ranks, key=ranks.__getitem__) or ([own] if own is not None else [])


def local_role(profile: Profile | StopProfile) -> Role | None:
    """Role of the operator at this computer; None: unrestricted, or unknown."""
    security = profile.session.security
    if security is None:
        return None
    try:
        files = Store(security.folder).identity_files(security.host, None, security.people)
    except SecurityError:
        return None
    return Role(files.certificate.stem)
