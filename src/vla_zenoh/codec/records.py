"""Structured records as msgpack maps with string keys: the field names of `vla_zenoh.types`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple, TypeVar

from vla_zenoh import keys
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, RecordError, SpecError
from vla_zenoh.types import Header, shown

Record = TypeVar("Record")

MAX_RECORD_BYTES = 4 * 1024 * 1024
SMALL_BYTES = 1024 * 1024
"""Any record but chunks, specs and what nodes say of themselves is smaller."""


def encode(record: Any) -> bytes:
    """Bytes of a record dataclass, or of a `vla_zenoh.policy.ModelSpec`.

    Raises:
        CodecError: larger than `MAX_RECORD_BYTES`, which every receiver rejects.
    """
    to_dict = getattr(record, "to_dict", None)  # of a ModelSpec
    fields = _fields(record) if to_dict is None else to_dict()
    payload = message.pack(fields)
    _check_length(type(record), payload)
    return payload


def decode(kind: type[Record], payload: bytes) -> Record:
    """Read a record of `kind`.

    Raises:
        CodecError: reason ``oversize``, ``malformed`` (not such a map) or ``invalid`` (a value that
            the record refuses: NaN, wrong shape, out of range).
    """
    _check_length(kind, payload)
    return from_map(kind, message.unpack(payload))


def from_map(kind: type[Record], data: Any) -> Record:
    """The record of what `encode` packs.

    Raises:
        CodecError: reason ``malformed`` or ``invalid``, as of `decode`.
    """
    if not isinstance(data, dict):
        raise CodecError("malformed", f"{kind.__name__} is a map, this is a {type(data).__name__}")
    from_dict = getattr(kind, "from_dict", None)
    if from_dict is not None:
        try:
            return from_dict(data)
        except SpecError as error:
            raise CodecError("invalid", str(error)) from error
    return _record(kind, data)


def _check_length(kind: type, payload: bytes) -> None:
    if len(payload) > MAX_RECORD_BYTES:
        raise CodecError(
            "oversize", f"{kind.__name__} of {len(payload)} bytes, at most {MAX_RECORD_BYTES}"
        )


class _Layout(NamedTuple):
    """Names of a record's fields."""

    names: tuple[str, ...]
    known: frozenset[str]
    required: tuple[str, ...]


@cache
def _layout(kind: type) -> _Layout:
    fields = dataclasses.fields(kind)
    names = tuple(field.name for field in fields)
    missing = dataclasses.MISSING
    required = tuple(
        field.name
        for field in fields
        if field.default is missing and field.default_factory is missing
    )
    return _Layout(names, frozenset(names), required)


def _fields(record: Any) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name in _layout(type(record)).names:
        value = getattr(record, name)
        if isinstance(value, Mapping):
            value = dict(value)
        elif hasattr(value, "__dataclass_fields__"):
            value = _fields(value)
        out[name] = value
    return out


def _record(kind: type[Record], data: Mapping[Any, Any]) -> Record:
    layout = _layout(kind)
    if data.keys() != layout.known:
        unknown = sorted(shown(name) for name in data if name not in layout.known)
        if unknown:
            raise CodecError("malformed", f"{kind.__name__} has no field {', '.join(unknown[:8])}")
        missing = [name for name in layout.required if name not in data]
        if missing:
            raise CodecError("malformed", f"{kind.__name__} lacks {', '.join(missing)}")
    if data.get("cause") is not None:
        data = {**data, "cause": _cause(data["cause"])}
    try:
        return kind(**data)
    except RecordError as error:
        raise CodecError("invalid", f"{kind.__name__}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {error}") from error


def _cause(value: Any) -> Any:
    if not isinstance(value, dict):
        raise CodecError("malformed", "cause is a map or nothing")
    from vla_zenoh.types import Cause  # brings numpy

    return _record(Cause, value)


MAX_HEADER_BYTES = 1024


# A header of ours in msgpack: every sample carries one, so it is written and read by a short cut.
# Its numbers always take eight bytes.
_UINT64, _SHORT_TEXT = b"\xcf", 0xA0
_SCHEMA = message.pack("schema") + message.pack(keys.SCHEMA)
_START = b"\x84" + _SCHEMA + message.pack("stamp_wall_ns") + _UINT64
_SEQ, _SOURCE = message.pack("seq") + _UINT64, message.pack("source")
_STAMP_END = len(_START) + 8
_SEQ_START = _STAMP_END + len(_SEQ)
_SEQ_END = _SEQ_START + 8
_SOURCE_START = _SEQ_END + len(_SOURCE)


def encode_header(header: Header) -> bytes:
    """Bytes of the attachment: a map of ``schema``, ``stamp_wall_ns``, ``seq`` and ``source``."""
    source = header.source.encode()
    size = len(source)
    return b"".join(
        (
            _START,
            header.stamp_wall_ns.to_bytes(8, "big"),
            _SEQ,
            header.seq.to_bytes(8, "big"),
            _SOURCE,
            bytes((_SHORT_TEXT | size,)) if size < 32 else message.pack(header.source)[:-size],
            source,
        )
    )


def _header_of_ours(attachment: bytes) -> Header | None:
    """What `encode_header` wrote, if its source is short; None: something else."""
    size = len(attachment) - _SOURCE_START - 1
    if (
        0 <= size < 32
        and attachment[_SOURCE_START] == _SHORT_TEXT | size
        and attachment[: len(_START)] == _START
        and attachment[_STAMP_END:_SEQ_START] == _SEQ
        and attachment[_SEQ_END:_SOURCE_START] == _SOURCE
    ):
        source = attachment[_SOURCE_START + 1 :]
        if source.isascii():
            return Header(
                int.from_bytes(attachment[len(_START) : _STAMP_END], "big"),
                int.from_bytes(attachment[_SEQ_START:_SEQ_END], "big"),
                source.decode(),
            )
    return None


def decode_header(attachment: bytes | None) -> Header:
    """Read an attachment.

    Raises:
        CodecError: ``no_header``, ``malformed``, ``schema`` for another version, or ``invalid``
            for a value out of range. Fields that a later version may add are passed over.
    """
    if attachment is None:
        raise CodecError("no_header", "the sample has no attachment; streams carry a header there")
    if len(attachment) > MAX_HEADER_BYTES:
        raise CodecError("malformed", f"a header of {len(attachment)} bytes")
    try:
        header = _header_of_ours(attachment)
    except RecordError as error:
        raise CodecError("invalid", str(error)) from error
    if header is not None:
        return header
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
