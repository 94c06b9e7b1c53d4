"""Folder of a lab's certificates, and checks of them.

::

    FOLDER/ca.pem, ca.key         authority; its key never leaves this computer
    FOLDER/HOST/ca.pem            copy FOLDER/HOST to that host, into its own FOLDER
    FOLDER/HOST/NODE.pem, .key    certificate and key of each node and operator of the host
    FOLDER/.this_host             name of the HOST that this computer is; not copied

Private keys are readable by their owner only. Nothing is overwritten unless requested.
"""

from __future__ import annotations

import datetime as dt
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vla_zenoh.errors import SecurityError
from vla_zenoh.security import authority as ca
from vla_zenoh.security.authority import Certificate, KeyPair
from vla_zenoh.security.identity import PEOPLE, Identity, Role, operator_role

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile

AUTHORITY = "ca"
THIS_HOST = ".this_host"
KEY_MODE = 0o600
FOLDER_MODE = 0o700


@dataclass(frozen=True, slots=True)
class Files:
    """The files of one identity."""

    authority: Path
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class Entry:
    """A certificate in the folder.

    Args:
        host: empty: the authority itself.
        node: or ``operator``, ``viewer``, ``ca``.
        path: of the certificate.
        certificate: its contents; None if it cannot be read.
        faults: why it is unusable or unsafe.
        warning: of its expiry.
    """

    host: str
    node: str
    path: Path
    certificate: Certificate | None
    faults: tuple[str, ...]
    warning: str


class Store:
    """Folder of a lab's certificates and keys.

    Args:
        folder: may begin with ``~``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()

    # -- making -------------------------------------------------------------------------------
    def make_authority(self, lab: str, now: dt.datetime) -> Path:
        """Make the lab's authority.

        Raises:
            SecurityError: it exists already, or the folder cannot be written.
        """
        path = self.folder / f"{AUTHORITY}.pem"
        self._write(self.folder, AUTHORITY, ca.make_authority(lab, now), renew=False)
        return path

    def add(
        self,
        identities: Iterable[Identity],
        now: dt.datetime,
        *,
        days: int = ca.CERTIFICATE_DAYS,
        addresses: Iterable[str] = (),
        renew: bool = False,
    ) -> list[Path]:
        """Make a certificate for each of `identities`; returns their files.

        Args:
            identities: of nodes and operators.
            now: UTC.
            days: validity.
            addresses: of routers, for clients.
            renew: replace existing ones; routers keep the addresses of those as well.

        Raises:
            SecurityError: one exists already, the authority's key is missing, or a file cannot be
                written. Nothing is written then.
        """
        identities, serving = list(identities), tuple(addresses)
        if not renew:
            for identity in identities:
                self._refuse_to_overwrite(self.files(identity.host, identity.node))
        authority = self._authority()
        pairs = [
            (
                identity,
                ca.issue(
                    authority,
                    identity.common_name,
                    now,
                    days=days,
                    addresses=(*serving, *self._served(identity))
                    if identity.role is Role.ROUTER
                    else identity.addresses or None,
                ),
            )
            for identity in identities
        ]
        made: list[Path] = []
        for identity, pair in pairs:
            folder = self.folder / identity.host
            made.append(self._write(folder, identity.node, pair, renew=renew))
            _put(folder / f"{AUTHORITY}.pem", authority.certificate, 0o644)
        return made

    def _authority(self) -> KeyPair:
        certificate, key = (self.folder / f"{AUTHORITY}.{end}" for end in ("pem", "key"))
        if not certificate.exists():
            raise SecurityError(f"{certificate} is not there: begin with `vla-zenoh secure init`")
        if not key.exists():
            raise SecurityError(
                f"{key} is not there: certificates are made on the computer where "
                "`vla-zenoh secure init` was run"
            )
        if fault := open_to_others(key):
            raise SecurityError(f"{fault}. Anyone who read it can issue certificates of this lab")
        return KeyPair(_get(certificate), _get(key))

    def _served(self, identity: Identity) -> tuple[str, ...]:
        """Addresses in the existing certificate; they are recorded nowhere else."""
        try:
            return ca.read(_get(self.files(identity.host, identity.node).certificate)).addresses
        except SecurityError:
            return ()

    def _write(self, folder: Path, name: str, pair: KeyPair, *, renew: bool) -> Path:
        files = Files(folder, folder / f"{name}.pem", folder / f"{name}.key")
        if not renew:
            self._refuse_to_overwrite(files)
        for made in (self.folder, folder):
            try:
                made.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            except OSError as error:
                raise SecurityError(f"{made} cannot be made: {error.strerror}") from error
        _put(files.key, pair.key, KEY_MODE)
        _put(files.certificate, pair.certificate, 0o644)
        return files.certificate

    @staticmethod
    def _refuse_to_overwrite(files: Files) -> None:
        for path in (files.certificate, files.key):
            if path.exists():
                raise SecurityError(
                    f"{path} is there already and is not overwritten; --renew makes new ones of a "
                    "host, another --folder holds another lab"
                )

    # -- using --------------------------------------------------------------------------------
    def files(self, host: str, node: str) -> Files:
        """Paths of the files of an identity."""
        folder = self.folder / host
        return Files(folder / f"{AUTHORITY}.pem", folder / f"{node}.pem", folder / f"{node}.key")

    def this_host(self, host: str | None) -> str:
        """Host that this computer is: `host`, or `known_host`.

        Raises:
            SecurityError: there are no certificates, or those of several hosts.
        """
        found = host or self.known_host()
        if found is not None:
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
        try:
            noted = (self.folder / THIS_HOST).read_text("utf-8").strip()
        except (OSError, UnicodeDecodeError):
            noted = ""
        if noted in hosts:
            return noted
        return hosts[0] if len(hosts) == 1 else None

    def remember_host(self, host: str) -> Path:
        """Note that this computer is `host`.

        Raises:
            SecurityError: the folder cannot be written.
        """
        path = self.folder / THIS_HOST
        _put(path, f"{host}\n".encode(), 0o644)
        return path

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
        """Files of a node of this computer or, without a node, of its operator.

        Args:
            host: that this computer is; None: `known_host`.
            node: name; None: the operator.
            people: ``session.security.people``. Where it names the host, only the certificate of
                that role is used: the router drops messages of others.

        Raises:
            SecurityError: they are missing, or others can read the key.
        """
        host = self.this_host(host)
        role = (people or {}).get(host)
        names = [node] if node is not None else [role] if role else [one.value for one in PEOPLE]
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

    # -- looking ------------------------------------------------------------------------------
    def entries(self, now: dt.datetime, host: str | None = None) -> list[Entry]:
        """All certificates, or those of one host, with their faults.

        Raises:
            MissingExtraError: the library ``cryptography`` is not installed.
        """
        own = self.folder / f"{AUTHORITY}.pem"
        out = [self._entry(own, own, "", now)] if own.exists() and host is None else []
        for name in self.hosts():
            if host is None or name == host:
                paths = sorted((self.folder / name).glob("*.pem"))
                signer = self.folder / name / f"{AUTHORITY}.pem"
                out += [self._entry(path, signer, name, now) for path in paths if path != signer]
        return out

    def _entry(self, path: Path, signer: Path, host: str, now: dt.datetime) -> Entry:
        node, found, warning = path.stem, None, ""
        faults: list[str] = []
        try:
            pem = _get(path)
            found = ca.read(pem)
            faults += [fault] if (fault := found.fault(now)) else []
            warning = found.warning(now)
            if not ca.signed_by(pem, _get(signer)):
                faults.append("was signed by another authority")
            if host and found.common_name != f"{node}@{host}":
                faults.append(f"is about {found.common_name!r}")
            faults += self._key_faults(path, host)
        except SecurityError as error:
            faults.append(str(error))
        return Entry(host, node, path, found, tuple(faults), warning)

    @staticmethod
    def _key_faults(path: Path, host: str) -> Iterator[str]:
        key = path.with_suffix(".key")
        if not key.exists():
            if host:
                yield f"{key.name} is not there"
            return
        if fault := open_to_others(key):
            yield fault
        if not ca.key_fits(KeyPair(_get(path), _get(key))):
            yield f"{key.name} belongs to another certificate"


def open_to_others(key: Path) -> str:
    """Sentence about a private key that other users can read; empty if none can."""
    mode = stat.S_IMODE(key.stat().st_mode)
    if mode & 0o077:
        return f"{key} can be read by others (mode {mode:o}): chmod 600 {key}"
    return ""


def _get(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SecurityError(f"{path} cannot be read: {error.strerror}") from error


def _put(path: Path, content: bytes, mode: int) -> None:
    """Write a file atomically; it has its mode from the start."""
    beside = path.with_name(f".{path.name}.new")
    try:
        beside.unlink(missing_ok=True)
        number = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(number, "wb") as file:
            file.write(content)
        beside.chmod(mode)
        beside.replace(path)
    except OSError as error:
        raise SecurityError(f"{path} cannot be written: {error.strerror}") from error


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
    """Role of the people at this computer; None: unrestricted, or unknown."""
    security = profile.session.security
    if security is None:
        return None
    try:
        files = Store(security.folder).identity_files(security.host, None, security.people)
    except SecurityError:
        return None
    return next((role for role in PEOPLE if role.value == files.certificate.stem), None)
