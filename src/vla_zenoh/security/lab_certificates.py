"""Makes and checks the certificates of a lab. Nothing is overwritten unless requested.

Needs the library ``cryptography``; nodes that only use their certificates do not, see `store`.
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from vla_zenoh.errors import SecurityError
from vla_zenoh.security import authority as ca
from vla_zenoh.security.authority import Certificate, KeyPair
from vla_zenoh.security.identity import Identity, Role
from vla_zenoh.security.store import AUTHORITY, THIS_HOST, Files, Store, open_to_others

KEY_MODE = 0o600
FOLDER_MODE = 0o700


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


class LabCertificates(Store):
    """Folder of a lab's certificates and keys, to make and to check them."""

    def make_authority(self, lab: str, now: dt.datetime) -> Path:
        """Make the lab's authority.

        Raises:
            SecurityError: it exists already, or the folder cannot be written.
        """
        self._refuse_to_overwrite(self.files("", AUTHORITY))
        return self._keep("", AUTHORITY, ca.make_authority(lab, now))

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
            made.append(self._keep(identity.host, identity.node, pair))
            _write(self.files(identity.host, "").authority, authority.certificate, 0o644)
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
        return KeyPair(_read(certificate), _read(key))

    def _served(self, identity: Identity) -> tuple[str, ...]:
        """Addresses in the existing certificate; they are recorded nowhere else."""
        try:
            return ca.read(_read(self.files(identity.host, identity.node).certificate)).addresses
        except SecurityError:
            return ()

    def _keep(self, host: str, node: str, pair: KeyPair) -> Path:
        files = self.files(host, node)
        for folder in (self.folder, files.key.parent):
            try:
                folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            except OSError as error:
                raise SecurityError(f"{folder} cannot be made: {error.strerror}") from error
        _write(files.key, pair.key, KEY_MODE)
        _write(files.certificate, pair.certificate, 0o644)
        return files.certificate

    @staticmethod
    def _refuse_to_overwrite(files: Files) -> None:
        for path in files[1:]:
            if path.exists():
                raise SecurityError(
                    f"{path} is there already and is not overwritten; --renew makes new ones of a "
                    "host, another --folder holds another lab"
                )

    def remember_host(self, host: str) -> Path:
        """Note that this computer is `host`.

        Raises:
            SecurityError: the folder cannot be written.
        """
        path = self.folder / THIS_HOST
        _write(path, f"{host}\n".encode(), 0o644)
        return path

    def entries(self, now: dt.datetime, host: str | None = None) -> list[Entry]:
        """All certificates, or those of one host, with their faults."""
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
            pem = _read(path)
            found = ca.read(pem)
            faults += [fault] if (fault := found.fault(now)) else []
            warning = found.warning(now)
            if not ca.signed_by(pem, _read(signer)):
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
        if not ca.key_fits(KeyPair(_read(path), _read(key))):
            yield f"{key.name} belongs to another certificate"


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SecurityError(f"{path} cannot be read: {error.strerror}") from error


def _write(path: Path, content: bytes, mode: int) -> None:
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
