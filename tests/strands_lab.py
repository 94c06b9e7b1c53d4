"""Certificates of a mesh of strands-robots."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.x509.oid import NameOID
from vla_zenoh_strands.identity import Identity

WALL_S = 1_900_000_000.0
"""They are valid for ten years before this."""
MAKE: dict[str, Callable[[], Any]] = {
    "rsa": lambda: rsa.generate_private_key(65537, 2048),
    "ec": lambda: ec.generate_private_key(ec.SECP256R1()),
    "ed25519": ed25519.Ed25519PrivateKey.generate,
}


class Lab:
    """An authority, and certificates of it."""

    def __init__(self, folder: Path, name: str = "mesh") -> None:
        self.folder, self._name, self._key = folder, name, MAKE["ec"]()
        self.authority = folder / f"{name}.pem"
        subject = self._subject(f"{name} authority")
        self._write(self.authority, self._issue(subject, subject, self._key))

    @staticmethod
    def _subject(name: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])

    def _issue(self, subject: x509.Name, issuer: x509.Name, of: Any) -> x509.Certificate:
        now = datetime.fromtimestamp(WALL_S, tz=UTC)
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer)
            .public_key(of.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(days=3650))
            .not_valid_after(now + timedelta(days=1))
        )
        return builder.sign(self._key, hashes.SHA256())

    @staticmethod
    def _write(path: Path, certificate: x509.Certificate) -> None:
        path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))

    def peer(self, name: str, kind: str = "ec") -> Identity:
        certificate, key = self.files(name, kind)
        return Identity.read(str(certificate), str(key))

    def files(self, name: str, kind: str = "ec") -> tuple[Path, Path]:
        own = MAKE[kind]()
        certificate = self.folder / f"{self._name}-{name}.pem"
        key = certificate.with_suffix(".key")
        subject, issuer = self._subject(name), self._subject(f"{self._name} authority")
        self._write(certificate, self._issue(subject, issuer, own))
        form = serialization.PrivateFormat.PKCS8
        none = serialization.NoEncryption()
        key.write_bytes(own.private_bytes(serialization.Encoding.PEM, form, none))
        return certificate, key
