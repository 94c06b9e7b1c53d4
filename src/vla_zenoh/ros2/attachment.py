"""Attachment of rmw_zenoh's samples, requests and replies: 33 bytes.

``int64 sequence number, int64 source time (ns), uint8 16, 16 bytes gid``, little-endian. A ROS 2
subscriber drops samples without it; a reply repeats number and gid of its request.
"""

from __future__ import annotations

import struct
from hashlib import blake2b
from typing import NamedTuple

from vla_zenoh.errors import CodecError

GID_BYTES = 16
_LAYOUT = struct.Struct(f"<qqB{GID_BYTES}s")
ATTACHMENT_BYTES = _LAYOUT.size


class Attachment(NamedTuple):
    """Sequence number, source time and writer of a sample, request or reply."""

    seq: int
    stamp_ns: int
    gid: bytes


def encode(attachment: Attachment) -> bytes:
    return _LAYOUT.pack(attachment.seq, attachment.stamp_ns, GID_BYTES, attachment.gid)


def decode(payload: bytes | None) -> Attachment:
    """Read the 33 bytes, or raise a `CodecError`: ``no_attachment``, or ``malformed``."""
    if payload is None:
        raise CodecError("no_attachment", "rmw_zenoh sends an attachment with everything")
    if len(payload) != ATTACHMENT_BYTES:
        why = f"an attachment of {len(payload)} bytes, wanted {ATTACHMENT_BYTES}"
        raise CodecError("malformed", why)
    seq, stamp_ns, length, gid = _LAYOUT.unpack(payload)
    if length != GID_BYTES or seq < 0 or stamp_ns < 0:
        raise CodecError("malformed", "an attachment of another layout")
    return Attachment(seq, stamp_ns, gid)


def gid_of(token: str) -> bytes:
    """GID of a writer: 16 bytes derived from its liveliness token, which is unique."""
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()
