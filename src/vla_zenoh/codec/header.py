"""The header that travels as a sample's attachment: a small msgpack map with short keys."""

from __future__ import annotations

from vla_zenoh import keys
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.types import Header, shown

MAX_HEADER_BYTES = 1024


def encode(header: Header) -> bytes:
    """Bytes of the attachment."""
    return message.pack(
        {
            "schema": keys.SCHEMA,
            "stamp_wall_ns": header.stamp_wall_ns,
            "seq": header.seq,
            "source": header.source,
        }
    )


def decode(attachment: bytes | None) -> Header:
    """Read an attachment.

    Raises:
        CodecError: ``no_header``, ``malformed``, ``schema`` for another version, or ``invalid``
            for a value out of range. Fields that a later version may add are passed over.
    """
    if attachment is None:
        raise CodecError("no_header", "the sample has no attachment; streams carry a header there")
    if len(attachment) > MAX_HEADER_BYTES:
        raise CodecError("malformed", f"a header of {len(attachment)} bytes")
    data = message.unpack(attachment)
    if not isinstance(data, dict):
        raise CodecError("malformed", f"the header is a {type(data).__name__}, wanted a map")
    schema = data.get("schema")
    if type(schema) is not int or schema != keys.SCHEMA:
        raise CodecError(
            "schema", f"schema {shown(schema)} is not ours ({keys.SCHEMA}); update one side"
        )
    try:
        return Header(data["stamp_wall_ns"], data["seq"], data["source"])
    except KeyError as error:
        raise CodecError("malformed", f"the header lacks {error}") from error
    except RecordError as error:
        raise CodecError("invalid", str(error)) from error
