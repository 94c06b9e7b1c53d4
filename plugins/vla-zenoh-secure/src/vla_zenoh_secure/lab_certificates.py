"""Makes the certificates of a lab. Nothing is overwritten unless requested."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable
from pathlib import Path

from vla_zenoh.errors import SecurityError
from vla_zenoh.lab.durable import write_whole, writing
from vla_zenoh.security.certificates import CheckedStore, read, read_file
from vla_zenoh.security.roles import Identity, Role
from vla_zenoh.security.store import AUTHORITY, THIS_HOST, Files, open_to_others
from vla_zenoh_secure import authority as ca
from vla_zenoh_secure.authority import KeyPair

KEY_MODE = 0o600
FOLDER_MODE = 0o700


class LabCertificates(CheckedStore):
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
        authority, pairs = self._authority(), list[KeyPair]()
        for identity in identities:
            served = identity.addresses or None
            if identity.role is Role.ROUTER:
                served = (*routers, *self._served(identity))
            pairs.append(
                ca.issue(authority, identity.common_name, now, days=days, addresses=served)
            )
        made: list[Path] = []
        for identity, pair in zip(identities, pairs, strict=True):
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


def _write(path: Path, content: bytes, mode: int) -> None:
    with writing(path, SecurityError):
        write_whole(path, content, mode)
        path.chmod(mode)  # whatever the umask
