"""Structured records as msgpack maps with string keys: the field names of `vla_zenoh.types`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar

from vla_zenoh import keys
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, RecordError, SpecError
from vla_zenoh.types import Header, shown

Record = TypeVar("Record")

MAX_RECORD_BYTES = 4 * 1024 * 1024
SMALL_BYTES = 1024 * 1024
"""All records but chunks, specs and node statuses are smaller."""


def encode(record: Any) -> bytes:
    """Bytes of a record dataclass, or of a `vla_zenoh.policy.ModelSpec`.

    Raises:
        CodecError: larger than `MAX_RECORD_BYTES`, which every receiver rejects.
    """
    payload = message.pack(_map_of(record))
    _check_length(type(record), payload)
    return payload


def decode(kind: type[Record], payload: bytes, unknown: list[str] | None = None) -> Record:
    """Read a record of `kind`.

    Fields that it does not know are ignored, and their names appended to `unknown`: a newer program
    may tell more. What has another meaning raises `vla_zenoh.keys.SCHEMA`.

    Raises:
        CodecError: reason ``oversize``, ``malformed`` (not such a map) or ``invalid`` (a value that
            the record rejects: NaN, wrong shape, out of range).
    """
    _check_length(kind, payload)
    return from_map(kind, message.unpack(payload), unknown)


def from_map(kind: type[Record], data: Any, unknown: list[str] | None = None) -> Record:
    """The record of what `encode` packs; raises as `decode`."""
    if not isinstance(data, dict):
        raise CodecError("malformed", f"{kind.__name__} is a map, this is a {type(data).__name__}")
    from_dict = getattr(kind, "from_dict", None)  # of a ModelSpec
    if from_dict is not None:
        try:
            return from_dict(data)
        except SpecError as error:
            raise CodecError("invalid", str(error)) from error
    return _record(kind, data, unknown)


def _check_length(kind: type, payload: bytes) -> None:
    if len(payload) > MAX_RECORD_BYTES:
        raise CodecError(
            "oversize", f"{kind.__name__} of {len(payload)} bytes, at most {MAX_RECORD_BYTES}"
        )


def _map_of(record: Any) -> Any:
    """A record as a map of its fields; other values as they are."""
    to_dict = getattr(record, "to_dict", None)  # of a ModelSpec
    if to_dict is not None:
        return to_dict()
    if dataclasses.is_dataclass(record):
        names = _names(type(record))
        return {name: _map_of(getattr(record, name)) for name in names}
    return dict(record) if isinstance(record, Mapping) else record


@cache
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _required(kind: type) -> tuple[str, ...]:
    missing = dataclasses.MISSING
    return tuple(
        field.name
        for field in dataclasses.fields(kind)
        if field.default is missing and field.default_factory is missing
    )


def _record(
    kind: type[Record], data: Mapping[Any, Any], unknown: list[str] | None = None
) -> Record:
    missing = [name for name in _required(kind) if name not in data]
    if missing:
        raise CodecError("malformed", f"{kind.__name__} lacks {', '.join(missing)}")
    fields = {name: data[name] for name in _names(kind) if name in data}
    if unknown is not None and len(fields) < len(data):
        others = (name for name in data if name not in fields)
        unknown.extend(f"{kind.__name__}.{shown(name)}" for name in others)
    cause = fields.get("cause")
    if cause is not None:
        if not isinstance(cause, dict):
            raise CodecError("malformed", "cause is a map or nothing")
        from vla_zenoh.types import Cause  # brings numpy

        fields["cause"] = _record(Cause, cause, unknown)
    return _made(kind, fields)


def _made(kind: type[Record], data: Mapping[Any, Any]) -> Record:
    try:
        return kind(**data)
    except RecordError as error:
        raise CodecError("invalid", f"{kind.__name__}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {error}") from error


MAX_HEADER_BYTES = 1024


def encode_header(header: Header) -> bytes:
    """Bytes of the attachment: a map of ``schema``, ``stamp_wall_ns``, ``seq`` and ``source``."""
    return message.pack({"schema": keys.SCHEMA, **_map_of(header)})


def decode_header(attachment: bytes | None) -> Header:
    """Read an attachment.

    Raises:
        CodecError: ``no_header``, ``malformed``, ``schema`` for another version, or ``invalid`` for
            a value out of range. Fields that a later version may add are ignored.
    """
    if attachment is None:
        raise CodecError("no_header", "the sample has no attachment; streams carry a header there")
    if len(attachment) > MAX_HEADER_BYTES:
        raise CodecError("malformed", f"a header of {len(attachment)} bytes")
    try:
        data = message.unpack(attachment)
        if not isinstance(data, dict):
            raise CodecError("malformed", f"the header is a {type(data).__name__}, wanted a map")
        schema = data.get("schema")
        if type(schema) is not int or schema != keys.SCHEMA:
            why = f"schema {shown(schema)} is not ours ({keys.SCHEMA}); update one side"
            raise CodecError("schema", why)
        return Header(data["stamp_wall_ns"], data["seq"], data["source"])
    except KeyError as error:
        raise CodecError("malformed", f"the header lacks {error}") from error
    except RecordError as error:
        raise CodecError("invalid", str(error)) from error
