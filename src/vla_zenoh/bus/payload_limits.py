"""Bytes out of Zenoh's hands: what they are is looked at before they are copied."""

from __future__ import annotations

import zenoh

from vla_zenoh.codec import header as header_codec
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Header


def bytes_of(payload: zenoh.ZBytes | None, limit: int = MAX_RECORD_BYTES) -> bytes:
    """The bytes; none are empty.

    Raises:
        CodecError: ``oversize``, more than `limit`.
    """
    if payload is None:
        return b""
    if len(payload) > limit:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {limit} are taken")
    return payload.to_bytes()


def check_size(sample: zenoh.Sample, limit: int) -> None:
    """Whether a sample may be taken. A deletion comes without bytes, and would pass for a setting.

    Raises:
        CodecError: ``deleted``, it was not put; ``oversize``, payload and attachment together are
            more than `limit`.
    """
    if sample.kind != zenoh.SampleKind.PUT:
        raise CodecError("deleted", "nothing is deleted here; what is put is taken")
    attachment = sample.attachment
    size = len(sample.payload) + (len(attachment) if attachment is not None else 0)
    if size > limit:
        raise CodecError("oversize", f"{size} bytes, at most {limit} are taken")


def payload_and_attachment(sample: zenoh.Sample, limit: int) -> tuple[bytes, bytes | None]:
    """Payload and attachment.

    Raises:
        CodecError: as `check` says.
    """
    check_size(sample, limit)
    attachment = sample.attachment
    return sample.payload.to_bytes(), attachment.to_bytes() if attachment is not None else None


def header_of(sample: zenoh.Sample) -> Header:
    """What the sample's writer says of it.

    Raises:
        CodecError: it has no header that can be read.
    """
    attachment = sample.attachment
    if attachment is None:
        return header_codec.decode(None)
    return header_codec.decode(bytes_of(attachment, header_codec.MAX_HEADER_BYTES))
