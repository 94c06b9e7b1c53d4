"""Certificate authority of a lab: issues certificates. Bytes in, bytes out.

X.509 version 3 (RFC 5280), keys on the curve P-256, ECDSA signatures with SHA-256, which every TLS
library accepts. Certificates of routers may serve and connect, all others only connect, so a stolen
worker's key cannot impersonate the router.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from vla_zenoh.errors import SecurityError
from vla_zenoh.security.certificates import load_pair  # first: says how to install cryptography

# isort: split
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 365
BACKDATE = dt.timedelta(minutes=10)
"""Certificates are valid from a little earlier: the clocks of a lab's hosts differ."""
MAX_COMMON_NAME = 64
"""Of RFC 5280, ub-common-name."""


class KeyPair(NamedTuple):
    """A certificate and its private key, as PEM text."""

    certificate: bytes
    key: bytes


def make_authority(name: str, now: dt.datetime, days: int = AUTHORITY_DAYS) -> KeyPair:
    """A new authority of the lab `name`: a key and a self-signed certificate; `now` is UTC.

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
        days: validity, limited by that of the authority.
        addresses: host names and IP addresses of a server; None: it may only connect.

    Raises:
        SecurityError: invalid name or address, or an authority that is invalid or expired.
    """
    signer, signer_key = load_pair(*authority)
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


def _address(address: str) -> x509.GeneralName:
    with suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(address.partition("%")[0]))
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
