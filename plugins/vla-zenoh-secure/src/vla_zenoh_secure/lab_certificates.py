"""Makes the certificates of a lab. Nothing is overwritten unless requested."""

from __future__ import annotations

import datetime as dt
import shutil
from collections.abc import Iterable
from pathlib import Path

import msgspec

from vla_zenoh.errors import SecurityError
from vla_zenoh.lab.durable import write_whole, writing
from vla_zenoh.security.certificates import CheckedStore, read, read_file
from vla_zenoh.security.names import NAMES, Names, read_names
from vla_zenoh.security.roles import Identity, Role
from vla_zenoh.security.store import AUTHORITY, THIS_HOST, Files, open_to_others
from vla_zenoh_secure import authority as ca
from vla_zenoh_secure.authority import KeyPair

KEY_MODE = 0o600
FOLDER_MODE = 0o700


class LabCertificates(CheckedStore):
    """Folder of a lab's certificates and keys, to make and to check them."""

    def keys_of_hosts(self) -> list[Path]:
        """Keys of all hosts, whether or not their other files are here."""
        return sorted(self.folder.glob("*/*.key"))

    def make_authority(self, lab: str, now: dt.datetime) -> Path:
        """Make the lab's authority.

        Raises:
            SecurityError: it exists already, or the folder cannot be written, or has certificates.
        """
        self._refuse_to_overwrite(self.files("", AUTHORITY))
        if orphans := self.keys_of_hosts():
            raise SecurityError(
                f"{orphans[0]} is of an authority that is not here. A second one would make "
                "certificates that the lab's routers reject: copy this host's folder again from "
                "the computer where `vla-zenoh secure init` was run, or name a new --folder"
            )
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
            addresses: at which clients look for routers.
            renew: replace existing ones; routers keep the addresses of those as well.

        Raises:
            SecurityError: one exists already, the authority's key is missing, or a file cannot be
                written. Nothing is written then.
        """
        identities, routers = list(identities), tuple(addresses)
        if not renew:
            for identity in identities:
                self._refuse_to_overwrite(self.files(identity.host, identity.node))
        authority, names, pairs = self._authority(), self.names(), list[KeyPair]()
        for identity in identities:
            served = identity.addresses or None
            if identity.role is Role.ROUTER:
                served = (*routers, *self._served(identity))
            name = names.current(identity.common_name)
            pairs.append(ca.issue(authority, name, now, days=days, addresses=served))
        made: list[Path] = []
        for identity, pair in zip(identities, pairs, strict=True):
            made.append(self._keep(identity.host, identity.node, pair))
            _write(self.files(identity.host, "").authority, authority.certificate, 0o644)
            _write_names(self.folder / identity.host, names)
        return made

    def names(self) -> Names:
        """Names that changed since the lab was made.

        Raises:
            SecurityError: the file cannot be read.
        """
        return read_names(self.folder)

    def change(self, names: Names) -> None:
        """Note that names changed, in the folder of each host, of which routers read theirs.

        Raises:
            SecurityError: this is not the authority's computer, or a file cannot be written.
        """
        self._authority()
        for folder in (self.folder, *(self.folder / host for host in self.hosts())):
            _write_names(folder, names)

    def revoke(
        self,
        host: str,
        identities: Iterable[Identity],
        now: dt.datetime,
        *,
        days: int = ca.CERTIFICATE_DAYS,
        addresses: Iterable[str] = (),
    ) -> list[Path]:
        """Give `host` a new name, and `identities` there certificates of it; returns their files.

        Those that are not among `identities` are deleted.

        Raises:
            SecurityError: as of `add` and `change`.
        """
        identities = list(identities)
        self.change(next_generation(self.names(), host))
        kept = {AUTHORITY, *(identity.node for identity in identities)}
        for path in [*self.files(host, "").key.parent.iterdir()]:
            if path.suffix in (".pem", ".key") and path.stem not in kept:
                path.unlink()
        return self.add(identities, now, days=days, addresses=addresses, renew=True)

    def retire(self, host: str) -> None:
        """Deny the name of `host` for good, and delete its certificates here.

        Raises:
            SecurityError: as of `change`.
        """
        self.change(next_generation(self.names(), host))
        if host in self.hosts():
            with writing(self.folder / host, SecurityError):
                shutil.rmtree(self.folder / host)

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
        return KeyPair(read_file(certificate), read_file(key))

    def _served(self, identity: Identity) -> tuple[str, ...]:
        """Addresses in the existing certificate; they are recorded nowhere else."""
        try:
            return read(read_file(self.files(identity.host, identity.node).certificate)).addresses
        except SecurityError:
            return ()

    def _keep(self, host: str, node: str, pair: KeyPair) -> Path:
        files = self.files(host, node)
        for folder in (self.folder, files.key.parent):
            with writing(folder, SecurityError):
                folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
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
        """Note that this computer is `host`."""
        path = self.folder / THIS_HOST
        _write(path, f"{host}\n".encode(), 0o644)
        return path


def next_generation(names: Names, host: str) -> Names:
    """The names after that of `host` was given up for its next one."""
    number = names.generations.get(host, 1) + 1
    return Names(names.revision + 1, names.generations | {host: number}, names.robots)


def renamed(names: Names, robot: str, new: str | None) -> Names:
    """The names after `robot` was called `new`, or was retired (None)."""
    robots = {name: new if now == robot else now for name, now in names.robots.items()}
    robots[robot] = new
    robots.pop(new or "", None)
    return Names(names.revision + 1, names.generations, robots)


def _write_names(folder: Path, names: Names) -> None:
    if names.revision:
        _write(folder / NAMES, msgspec.json.format(msgspec.json.encode(names)) + b"\n", 0o644)


def _write(path: Path, content: bytes, mode: int) -> None:
    with writing(path, SecurityError):
        write_whole(path, content, mode)
        path.chmod(mode)  # whatever the umask
