"""msgpack of plain values: maps with text for keys, lists, text, numbers, bools, nil and bytes."""

from __future__ import annotations

from typing import Any

from msgspec import DecodeError, MsgspecError, Raw, msgpack

from vla_zenoh.errors import CodecError
from vla_zenoh.types.form import ENCODING_ERRORS, encode_plain

MAX_PAYLOAD_BYTES = 64 * 1024 * 1024

DECODING_ERRORS = (DecodeError, ValueError, OverflowError, RecursionError)
"""Errors of msgspec when it decodes: ValueError is text that is not UTF-8."""


def pack(value: Any) -> bytes:
    """Encode plain values, records and arrays, which become lists.

    Raises:
        CodecError: a value of another type.
    """
    try:
        return encode_plain(value)
    except (MsgspecError, *ENCODING_ERRORS) as error:
        raise CodecError("unencodable", f"cannot be written as msgpack: {error}") from error


def unpack(payload: bytes, most_bytes: int = MAX_PAYLOAD_BYTES) -> Any:
    """Decode any msgpack.

    Raises:
        CodecError: more than `most_bytes`, or not msgpack.
    """
    if len(payload) > most_bytes:
        raise CodecError("oversize", f"payload of {len(payload)} bytes, at most {most_bytes}")
    try:
        # Walked through once before memory is taken: a list may claim more than there is.
        return msgpack.decode(memoryview(msgpack.decode(payload, type=Raw)))
    except DECODING_ERRORS as error:
        raise malformed(error) from error


def fields_of(what: str, payload: bytes) -> dict[str, Raw]:
    """The undecoded fields of a map, none of nil; raises a `CodecError` for anything else."""
    try:
        return _FIELDS.decode(payload) or {}
    except DECODING_ERRORS as error:
        raise malformed(error, f"{what} is a map of its fields") from error


_FIELDS = msgpack.Decoder(dict[str, Raw] | None)


def malformed(error: Exception, what: str = "not valid msgpack") -> CodecError:
    """The error of a payload that msgspec does not read."""
    reason = str(error) or type(error).__name__
    return CodecError("malformed", f"{what}: {reason[:200]}")
