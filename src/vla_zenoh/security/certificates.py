"""Reads and checks the certificates of a computer.

Needs the library ``cryptography``; nodes that only use their certificates do without it, see
`store`. The package vla-zenoh-secure makes them.
"""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vla_zenoh.errors import MissingExtraError, SecurityError, counted
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import ANYWHERE, address_of, host_of
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.names import read_names
from vla_zenoh.security.roles import identities
from vla_zenoh.security.store import AUTHORITY, Store, open_to_others

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID
except ImportError as error:
    raise MissingExtraError("cryptography", "secure") from error

WARN_DAYS = 30
"""A certificate that expires within this time should be renewed."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """Contents of a certificate; times are UTC, `addresses` those it is valid for as a server."""

    common_name: str
    not_before: dt.datetime
    not_after: dt.datetime
    addresses: tuple[str, ...]

    def days_left(self, now: dt.datetime) -> int:
        """Whole days until it expires; negative if it has."""
        return math.floor((self.not_after - now) / dt.timedelta(days=1))

    def fault(self, now: dt.datetime) -> str:
        """Why it is invalid at `now`; empty if it is valid."""
        if now < self.not_before:
            return f"is not valid before {self.not_before:%Y-%m-%d %H:%M} UTC (is the clock right?)"
        if now > self.not_after:
            return f"expired on {self.not_after:%Y-%m-%d}; renew it"
        return ""

    def warning(self, now: dt.datetime) -> str:
        """Warning of an expiry within `WARN_DAYS`; empty if there is none."""
        left = self.days_left(now)
        soon = left < WARN_DAYS and not self.fault(now)
        return f"ends in {counted(left, 'day')}; renew it" if soon else ""


@dataclass(frozen=True, slots=True)
class Entry:
    """A certificate in the folder, and why it is unusable or unsafe, or will be."""

    host: str  # empty: the authority itself
    node: str  # or operator, viewer, ca
    path: Path
    certificate: Certificate | None  # None: it cannot be read
    faults: tuple[str, ...]
    warning: str


class CheckedStore(Store):
    """Folder of a lab's certificates and keys, to check them."""

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
        node, key, found, warning = path.stem, path.with_suffix(".key"), None, ""
        faults: list[str] = []
        try:
            pem = read_file(path)
            found = read(pem)
            faults.append(found.fault(now))
            warning = found.warning(now)
            if not signed_by(pem, read_file(signer)):
                faults.append("was signed by another authority")
            if host and found.common_name != (
                valid := read_names(path.parent).current(f"{node}@{host}")
            ):
                faults.append(f"is about {found.common_name!r}, and {valid!r} has the rights")
            if key.exists():
                faults.append(open_to_others(key))
                own, private = load_pair(pem, read_file(key))
                if own.public_key() != private.public_key():
                    faults.append(f"{key.name} belongs to another certificate")
            elif host:
                faults.append(f"{key.name} is not there")
        except SecurityError as error:
            faults.append(str(error))
        return Entry(host, node, path, found, tuple(filter(None, faults)), warning)


def read(pem: bytes) -> Certificate:
    """Contents of a certificate, or a `SecurityError`."""
    found = _parsed(pem)
    names = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        addresses = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        addresses = ()
    return Certificate(
        str(names[0].value) if names else "",
        found.not_valid_before_utc,
        found.not_valid_after_utc,
        tuple(str(address.value) for address in addresses),
    )


def signed_by(pem: bytes, authority: bytes) -> bool:
    """Whether `authority` signed the certificate `pem`; a `SecurityError` if one is none."""
    found, signer = _parsed(pem), _parsed(authority)
    try:
        found.verify_directly_issued_by(signer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _parsed(pem: bytes) -> x509.Certificate:
    try:
        found = x509.load_pem_x509_certificate(pem)
        _ = found.extensions  # parsed at the first access
    except ValueError as error:
        raise SecurityError(f"is not a certificate: {error}") from error
    return found


def load_pair(
    certificate: bytes, key: bytes
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """A certificate and a private key of PEM text; `SecurityError`: one cannot be read."""
    try:
        found = x509.load_pem_x509_certificate(certificate)
        private = serialization.load_pem_private_key(key, password=None)
    except (ValueError, TypeError) as error:
        raise SecurityError(f"cannot be read as certificate and private key: {error}") from error
    if not isinstance(private, ec.EllipticCurvePrivateKey):
        raise SecurityError("the private key is not one of an elliptic curve, as we make them")
    return found, private


def read_file(path: Path) -> bytes:
    """Text of a PEM file, or a `SecurityError`."""
    try:
        pem = path.read_bytes()
    except OSError as error:
        raise SecurityError(f"{path} cannot be read: {error.strerror}") from error
    if not re.search(rb"^-----BEGIN", pem, re.MULTILINE):  # Zenoh would find nothing in it
        raise SecurityError(f"{path} has no line that begins with -----BEGIN")
    return pem


def router_names(profile: Profile) -> list[str]:
    """Names and addresses at which a profile looks for its routers."""
    session = profile.session
    endpoints = [*session.connect, *session.listen]
    for host in profile.hosts.values():
        endpoints += [*(host.connect or ()), *(host.listen or ()), *(host.link or ())]
    named = [host_of(one) for one in endpoints if not address_of(one).startswith(ANYWHERE)]
    return [name for name in dict.fromkeys(named) if name]


def unfit_certificates(profile: Profile, entries: Iterable[Entry]) -> dict[Path, str]:
    """Certificates that do not fit the profile any more: file -> why, and what to do.

    The router drops the traffic of some, after a role was reduced or a node was removed; no client
    trusts those of a router that has another address now.
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
        elif entry.certificate is not None and (valid := entry.certificate.addresses):
            lacks = ", ".join(name for name in router_names(profile) if name not in valid)
            if lacks:
                out[entry.path] = (
                    f"is not valid for {lacks}, where {profile.name} looks for a router: "
                    f"`vla-zenoh secure add {entry.host} --renew`, and copy it"
                )
    return out
