"""Records as plain msgpack maps: the field names of `vla_zenoh.types`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from msgspec import Raw

from vla_zenoh import keys
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, RecordError, SpecError
from vla_zenoh.types import Header
from vla_zenoh.types.form import Form, form_of, shown

Record = TypeVar("Record")

MAX_RECORD_BYTES = 4 * 1024 * 1024
SMALL_BYTES = 1024 * 1024
"""All records but chunks and node statuses are smaller."""
MAX_SPEC_BYTES = 64 * 1024


def encode(record: Any) -> bytes:
    """Bytes of a record, or of a `vla_zenoh.policy.ModelSpec`.

    Raises:
        CodecError: larger than `MAX_RECORD_BYTES`, which every receiver rejects.
    """
    to_dict = getattr(record, "to_dict", None)  # of a ModelSpec
    payload = message.pack(record if to_dict is None else to_dict())
    _check_length(type(record), payload, MAX_RECORD_BYTES)
    return payload


def decode(kind: type[Record], payload: bytes, unknown: list[str] | None = None) -> Record:
    """Read a record of `kind`.

    Fields that it does not know are ignored, and their names appended to `unknown`: a newer program
    may tell more. What has another meaning raises `vla_zenoh.keys.SCHEMA`.

    Raises:
        CodecError: reason ``oversize``, ``malformed`` (not such a map) or ``invalid`` (a value that
            the record rejects: NaN, wrong length, out of range).
    """
    _check_length(kind, payload, MAX_RECORD_BYTES)
    if _is_spec(kind):
        _check_length(kind, payload, MAX_SPEC_BYTES)
        return _spec(kind, message.unpack(payload))
    return _decode(kind, message.fields_of(kind.__name__, payload), payload, unknown)


def _decode(
    kind: type[Record], fields: Mapping[str, Raw], payload: bytes, unknown: list[str] | None
) -> Record:
    form = form_of(kind)
    _check_names(form, fields, unknown)
    try:
        return form.read(payload)
    except RecordError as error:
        raise CodecError("invalid", f"{kind.__name__}: {error}") from error
    except message.DECODING_ERRORS as error:
        raise message.malformed(error, kind.__name__) from error


def from_map(kind: type[Record], data: Any) -> Record:
    """The record of what `message.unpack` makes of its bytes; raises as `decode`."""
    if _is_spec(kind):
        return _spec(kind, data)
    return decode(kind, message.pack(data))


def _is_spec(kind: type[Any]) -> bool:
    return hasattr(kind, "from_dict")  # a ModelSpec


def _spec(kind: Any, data: Any) -> Any:
    try:
        return kind.from_dict(data)
    except SpecError as error:
        raise CodecError("invalid", str(error)) from error


def _check_length(kind: type, payload: bytes, most: int) -> None:
    if len(payload) > most:
        raise CodecError("oversize", f"{kind.__name__} of {len(payload)} bytes, at most {most}")


def _check_names(form: Form, fields: Mapping[str, Raw], unknown: list[str] | None) -> None:
    missing = [field for field in form.required if field not in fields]
    if missing:
        raise CodecError("malformed", f"{form.kind.__name__} lacks {', '.join(missing)}")
    if unknown is not None:
        unknown.extend(_unknown(form, fields))
        for field, part in form.parts.items():
            if field in fields:
                unknown.extend(_unknown(part, message.fields_of(field, bytes(fields[field]))))


def _unknown(form: Form, fields: Mapping[str, Raw]) -> list[str]:
    name = form.kind.__name__
    return [f"{name}.{shown(field)}" for field in fields if field not in form.names]


MAX_HEADER_BYTES = 1024


def encode_header(header: Header) -> bytes:
    """Bytes of the attachment: a map of ``schema``, ``stamp_wall_ns``, ``seq`` and ``source``."""
    return message.pack({"schema": keys.SCHEMA, **{n: getattr(header, n) for n in _HEADER.names}})


def decode_header(attachment: bytes | None, unknown: list[str] | None = None) -> Header:
    """Read an attachment; for `unknown` see `decode`.

    Raises:
        CodecError: ``no_header``, ``malformed``, ``schema`` for another version, or ``invalid`` for
            a value out of range.
    """
    if attachment is None:
        raise CodecError("no_header", "the sample has no attachment; streams carry a header there")
    if len(attachment) > MAX_HEADER_BYTES:
        raise CodecError("malformed", f"a header of {len(attachment)} bytes")
    fields = message.fields_of("the header", attachment)
    schema = message.unpack(bytes(fields.pop("schema"))) if "schema" in fields else None
    if type(schema) is not int or schema != keys.SCHEMA:
        raise CodecError("schema", _other_version(schema))
    return _decode(Header, fields, attachment, unknown)


def _other_version(schema: Any) -> str:
    newer = type(schema) is int and schema > keys.SCHEMA
    stale = "this side" if newer else "the sender"
    return (
        f"schema {shown(schema)} of the wire, this program has {keys.SCHEMA}: update vla-zenoh on "
        f"{stale}"
    )


_HEADER = form_of(Header)
