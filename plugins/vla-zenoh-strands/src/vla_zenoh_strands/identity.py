"""Signed messages of the mesh: who wrote one, by the certificate that signed it. No Zenoh.

The block ``sig`` of a message has the certificate, a time, a nonce and a signature over the
canonical JSON of all other fields and of its own. The certificate is issued by an authority of the
mesh; its common name is the peer that it speaks for.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa
from cryptography.x509.oid import NameOID

from vla_zenoh.errors import SecurityError
from vla_zenoh_strands.wire import Message, RefusalError, number

MAX_AGE_S, MAX_EARLY_S = 60.0, 5.0
"""Theirs: a signature is good from 5 s before its time to a minute after it."""
_MAX_CERTIFICATE_BYTES = 4096
_FIELDS = frozenset(("v", "alg", "cert", "t", "nonce", "sig"))
_PSS = padding.PSS(mgf=padding.MGF1(hashes.SHA256()), salt_length=32)


def speaks_for(common_name: str, peer: str) -> bool:
    """Whether a certificate speaks for a peer: of its name, or a robot that runs below it."""
    return peer == common_name or peer.startswith(f"{common_name}__")


@dataclass(frozen=True)
class Signature:
    """What a signature was found to say.

    Args:
        name: common name of the certificate.
        once: names this message; a second one with it is a replay.
    """

    name: str
    once: str


@dataclass(frozen=True)
class Authorities:
    """Certificates of who may issue certificates of the mesh."""

    roots: tuple[x509.Certificate, ...]

    @classmethod
    def read(cls, path: str) -> Authorities:
        """Of a PEM file.

        Raises:
            SecurityError: it cannot be read.
        """
        try:
            return cls(tuple(x509.load_pem_x509_certificates(Path(path).read_bytes())))
        except (OSError, ValueError) as error:
            raise SecurityError(f"{path}: no certificates of authorities: {error}") from error

    def verify(self, message: Message, wall_s: float) -> Signature:
        """Who signed a message.

        Raises:
            RefusalError: ``unsigned``: nobody whom we know, or too long ago.
        """
        try:
            return self._verify(message, wall_s)
        except (KeyError, TypeError, ValueError, binascii.Error, InvalidSignature) as error:
            why = "not what was signed" if isinstance(error, InvalidSignature) else str(error)
            raise RefusalError("unsigned", f"no valid signature: {why}") from error

    def _verify(self, message: Message, wall_s: float) -> Signature:
        block = message["sig"]
        if not isinstance(block, dict) or set(block) != _FIELDS or block["v"] != 1:
            raise ValueError("its block sig is of no version that is known")
        der = base64.b64decode(block["cert"])
        if len(der) > _MAX_CERTIFICATE_BYTES:
            raise ValueError(f"its certificate has more than {_MAX_CERTIFICATE_BYTES} bytes")
        leaf = x509.load_der_x509_certificate(der)
        if not any(_issued(leaf, root) for root in self.roots):
            raise ValueError("no authority of ours issued its certificate")
        now = datetime.fromtimestamp(wall_s, tz=UTC)
        if not leaf.not_valid_before_utc <= now <= leaf.not_valid_after_utc:
            raise ValueError("its certificate is not valid now")
        at_s = number(block["t"])
        if at_s is None or not -MAX_EARLY_S <= wall_s - at_s <= MAX_AGE_S:
            raise ValueError("it was not signed within the last minute; synchronise the clocks")
        (name,) = (
            str(one.value) for one in leaf.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        )
        covered = _covered({k: v for k, v in message.items() if k != "sig"}, block, der)
        key, signature = leaf.public_key(), base64.urlsafe_b64decode(block["sig"])
        if _algorithm(key) != block["alg"]:
            raise ValueError(f"its algorithm is not that of its key: {block['alg']!r:.40}")
        match key:
            case rsa.RSAPublicKey():
                key.verify(signature, covered, _PSS, hashes.SHA256())
            case ec.EllipticCurvePublicKey():
                key.verify(signature, covered, ec.ECDSA(hashes.SHA256()))
            case ed25519.Ed25519PublicKey():
                key.verify(signature, covered)
            case _:
                raise ValueError("its key is of no kind that is known")
        return Signature(name, f"{hashlib.sha256(der).hexdigest()} {block['nonce']}")


@dataclass(frozen=True)
class Identity:
    """Our own certificate and key, with which messages are signed."""

    name: str
    _der: bytes
    _key: Any

    @classmethod
    def read(cls, certificate: str, key: str) -> Identity:
        """Of two PEM files.

        Raises:
            SecurityError: they cannot be read, or do not belong together.
        """
        try:
            leaf = x509.load_pem_x509_certificate(Path(certificate).read_bytes())
            own = serialization.load_pem_private_key(Path(key).read_bytes(), None)
            (name,) = leaf.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        except (OSError, ValueError, TypeError) as error:
            raise SecurityError(f"{certificate}, {key}: no certificate and key: {error}") from error
        if own.public_key() != leaf.public_key() or not _algorithm(leaf.public_key()):
            raise SecurityError(f"{key} is not the key of {certificate}, or of an unknown kind")
        return cls(str(name.value), leaf.public_bytes(serialization.Encoding.DER), own)

    def sign(self, body: Message, wall_s: float) -> Message:
        """The message with a signature."""
        block: Message = {
            "v": 1,
            "alg": _algorithm(self._key.public_key()),
            "cert": base64.b64encode(self._der).decode(),
            "t": wall_s,
            "nonce": secrets.token_hex(16),
        }
        covered = _covered(body, block, self._der)
        match self._key:
            case rsa.RSAPrivateKey():
                signature = self._key.sign(covered, _PSS, hashes.SHA256())
            case ec.EllipticCurvePrivateKey():
                signature = self._key.sign(covered, ec.ECDSA(hashes.SHA256()))
            case _:
                signature = self._key.sign(covered)
        return {**body, "sig": {**block, "sig": base64.urlsafe_b64encode(signature).decode()}}


def _algorithm(key: object) -> str:
    match key:
        case rsa.RSAPublicKey():
            return "rsa-pss-sha256"
        case ec.EllipticCurvePublicKey():
            return "ecdsa-sha256"
        case ed25519.Ed25519PublicKey():
            return "ed25519"
        case _:
            return ""


def _covered(body: Message, block: Message, der: bytes) -> bytes:
    signed = {name: block[name] for name in ("v", "alg", "t", "nonce")}
    signed["cert_sha256"] = hashlib.sha256(der).hexdigest()
    return json.dumps({"body": body, "sig": signed}, sort_keys=True, separators=(",", ":")).encode()


def _issued(leaf: x509.Certificate, root: x509.Certificate) -> bool:
    try:
        leaf.verify_directly_issued_by(root)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True
