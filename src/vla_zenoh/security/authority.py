"""Certificate authority of a lab: issues certificates and reads them. Bytes in, bytes out.

X.509 version 3 (RFC 5280), keys on the curve P-256, ECDSA signatures with SHA-256, which every TLS
library accepts. Certificates of routers may serve and connect, all others only connect, so a stolen
worker's key cannot impersonate the router.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import math
from collections.abc import Iterable
from dataclasses import dataclass

from vla_zenoh.errors import MissingExtraError, SecurityError

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:  # nodes that only use their certificates do without it
    raise MissingExtraError("cryptography", "secure") from error

AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 365
WARN_DAYS = 30
"""A certificate that expires within this time should be renewed."""
BACKDATE = dt.timedelta(minutes=10)
"""Certificates are valid from a little earlier: the clocks of a lab's hosts differ."""
MAX_COMMON_NAME = 64
"""Of RFC 5280, ub-common-name."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate and its private key, as PEM text."""

    certificate: bytes
    key: bytes


@dataclass(frozen=True, slots=True)
class Certificate:
    """Contents of a certificate.

    Args:
        common_name: of its subject.
        not_before: valid from, UTC.
        not_after: valid until, UTC.
        addresses: host names and IP addresses that it is valid for as a server.
    """

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
        if self.fault(now) or left >= WARN_DAYS:
            return ""
        return f"ends in {left} day{'s' if left != 1 else ''}; renew it"


def make_authority(name: str, now: dt.datetime, days: int = AUTHORITY_DAYS) -> KeyPair:
    """A new authority: a key and a self-signed certificate.

    Args:
        name: of the lab, at most 64 characters.
        now: UTC.
        days: validity.

    Raises:
        SecurityError: invalid name.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    return _signed(_builder(name, None, key.public_key(), now, days), key, key)


def issue(
    authority: KeyPair,
    common_name: str,
    now: dt.datetime,
    *,
    days: int = CERTIFICATE_DAYS,
    addresses: Iterable[str] | None = None,
) -> KeyPair:
    """A certificate for `common_name`, signed by `authority`.

    Args:
        authority: of the lab.
        common_name: at most 64 characters.
        now: UTC.
        days: validity, limited by that of the authority.
        addresses: host names and IP addresses of a server; None: it may only connect.

    Raises:
        SecurityError: invalid name or address, or an authority that is invalid or expired.
    """
    signer, signer_key = _load(authority)
    end = signer.not_valid_after_utc
    if now > end:
        raise SecurityError(f"the lab's authority expired on {end:%Y-%m-%d}: make a new one")
    key = ec.generate_private_key(ec.SECP256R1())
    valid_days = min(days, (end - now) / dt.timedelta(days=1))
    builder = _builder(common_name, signer.subject, key.public_key(), now, valid_days)
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if addresses is not None:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = [_address(address) for address in dict.fromkeys(addresses)]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    signed_with = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer_key.public_key())
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    return _signed(builder.add_extension(signed_with, critical=False), key, signer_key)


def read(pem: bytes) -> Certificate:
    """Contents of a certificate.

    Raises:
        SecurityError: not a certificate.
    """
    try:
        found = x509.load_pem_x509_certificate(pem)
        extensions = found.extensions
    except ValueError as error:
        raise SecurityError(f"is not a certificate: {error}") from error
    names = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        addresses = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        addresses = ()
    return Certificate(
        str(names[0].value) if names else "",
        found.not_valid_before_utc,
        found.not_valid_after_utc,
        tuple(str(address.value) for address in addresses),
    )


def signed_by(pem: bytes, authority: bytes) -> bool:
    """Whether `authority` signed the certificate `pem`.

    Raises:
        SecurityError: one of them is not a certificate.
    """
    try:
        found, signer = map(x509.load_pem_x509_certificate, (pem, authority))
    except ValueError as error:
        raise SecurityError(f"is not a certificate: {error}") from error
    try:
        found.verify_directly_issued_by(signer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def key_fits(pair: KeyPair) -> bool:
    """Whether the private key belongs to the certificate.

    Raises:
        SecurityError: one of them cannot be read.
    """
    certificate, key = _load(pair)
    return certificate.public_key() == key.public_key()


def _address(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address.partition("%")[0]))
    except ValueError:
        pass
    try:
        return x509.DNSName(address)
    except ValueError as error:
        raise SecurityError(f"{address!r} is no host name and no IP address") from error


def _builder(
    common_name: str,
    issuer: x509.Name | None,
    public_key: ec.EllipticCurvePublicKey,
    now: dt.datetime,
    days: float,
) -> x509.CertificateBuilder:
    """What every certificate has; without an `issuer` it is of an authority, its own issuer."""
    if not 0 < len(common_name) <= MAX_COMMON_NAME:
        raise SecurityError(
            f"{common_name[:80]!r} cannot be the name in a certificate: give 1 to "
            f"{MAX_COMMON_NAME} characters; shorter names of node and host help"
        )
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    signs, end = issuer is None, now + dt.timedelta(days=days)
    usage = x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer or subject)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - BACKDATE)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
        .add_extension(x509.BasicConstraints(signs, 0 if signs else None), critical=True)
        .add_extension(usage, critical=True)
    )


def _signed(
    builder: x509.CertificateBuilder,
    key: ec.EllipticCurvePrivateKey,
    signer: ec.EllipticCurvePrivateKey,
) -> KeyPair:
    certificate = builder.sign(signer, hashes.SHA256())
    return KeyPair(
        certificate.public_bytes(serialization.Encoding.PEM),
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ),
    )


def _load(pair: KeyPair) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        certificate = x509.load_pem_x509_certificate(pair.certificate)
        key = serialization.load_pem_private_key(pair.key, password=None)
    except (ValueError, TypeError) as error:
        raise SecurityError(f"cannot be read as certificate and private key: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise SecurityError("the private key is not one of an elliptic curve, as we make them")
    return certificate, key
