"""Structured records as msgpack maps with string keys: the field names of `vla_zenoh.types`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from math import isfinite
from struct import Struct
from typing import Any, NamedTuple, TypeVar

import msgpack

from vla_zenoh import keys
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, RecordError, SpecError
from vla_zenoh.types import Header, shown
from vla_zenoh.types.stream import set_field

Record = TypeVar("Record")

MAX_RECORD_BYTES = 4 * 1024 * 1024
SMALL_BYTES = 1024 * 1024
"""All records but chunks, specs and node statuses are smaller."""


def encode(record: Any) -> bytes:
    """Bytes of a record dataclass, or of a `vla_zenoh.policy.ModelSpec`.

    Raises:
        CodecError: larger than `MAX_RECORD_BYTES`, which every receiver rejects.
    """
    to_dict = getattr(record, "to_dict", None)  # of a ModelSpec
    if type(record).__name__ in _STREAMED:
        payload = _as_last(record) or _in_full(record)
    else:
        payload = message.pack(_fields(record) if to_dict is None else to_dict())
    _check_length(type(record), payload)
    return payload


def decode(kind: type[Record], payload: bytes) -> Record:
    """Read a record of `kind`.

    Raises:
        CodecError: reason ``oversize``, ``malformed`` (not such a map) or ``invalid`` (a value that
            the record rejects: NaN, wrong shape, out of range).
    """
    _check_length(kind, payload)
    frame = _frames.get((kind, len(payload)))
    if frame is not None:
        same, record = _newest.get(kind, (b"", None))
        if payload == same:  # an arm at rest; records never change
            return record  # pyright: ignore
        pieces = frame.split.unpack(payload)
        if pieces[::2] == frame.constants:
            record = _refilled(kind, frame, pieces[1::2])
            _newest[kind] = payload, record
            return record
    record = from_map(kind, message.unpack(payload))
    if kind.__name__ in _STREAMED:
        _keep_frame(record, payload)
    return record


def from_map(kind: type[Record], data: Any) -> Record:
    """The record of what `encode` packs; raises as `decode`."""
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
    """Names of a record's fields, and the first bytes of its map."""

    head: bytes
    names: tuple[str, ...]
    known: frozenset[str]
    required: tuple[str, ...]


@cache
def _layout(kind: type) -> _Layout:
    fields = dataclasses.fields(kind)
    names = tuple(field.name for field in fields)
    missing = dataclasses.MISSING
    required = tuple(
        f.name for f in fields if f.default is missing and f.default_factory is missing
    )
    head = msgpack.Packer().pack_map_header(len(names))
    return _Layout(head, names, frozenset(names), required)


def _fields(record: Any) -> dict[str, Any]:
    fields = ((name, getattr(record, name)) for name in _layout(type(record)).names)
    return {name: dict(value) if hasattr(value, "keys") else value for name, value in fields}


_STREAMED = {"GripperState", "JointCommand", "JointState", "PoseCommand", "PoseState"}
"""Records that come in every tick: most of the time would go into their maps and lists."""


class _Form(NamedTuple):
    """How the last record of a kind was written, for the next one with other numbers.

    Args:
        start: bytes before the first number.
        numbers: name of each field that is one or a vector of them; type and bytes of the vector,
            None and 0 for a float; and the constant bytes after it.
        same: the other fields.
    """

    start: bytes
    numbers: tuple[tuple[str, Any, int, bytes], ...]
    same: tuple[tuple[str, Any], ...]


_forms: dict[type, _Form] = {}


def _as_last(record: Any) -> bytes | None:
    """The bytes of a record that differs from the last one of its kind in numbers alone."""
    form = _forms.get(type(record))
    if form is None:
        return None
    for name, value in form.same:
        if getattr(record, name) is not value:
            return None
    pieces = [form.start]
    for name, kind, size, after in form.numbers:
        value = getattr(record, name)
        if kind is None:
            if type(value) is not float:
                return None
            value = _FLOAT.pack(value)
        elif getattr(value, "dtype", None) is not kind or value.ndim != 1 or value.nbytes != size:
            return None
        else:
            value = value.tobytes()
        pieces += value, after
    return b"".join(pieces)


def _in_full(record: Any) -> bytes:
    pieces = _pieces(record)
    after, numbers, same = iter(pieces[2::2]), list[Any](), list[Any]()
    for name in _layout(type(record)).names:
        value = getattr(record, name)
        if type(value) is float:
            numbers.append((name, None, 0, next(after)))
        elif _is_vector(value):
            numbers.append((name, value.dtype, value.nbytes, next(after)))
        else:
            same.append((name, value))
    _forms[type(record)] = _Form(pieces[0], tuple(numbers), tuple(same))
    return b"".join(pieces)


def _is_vector(value: Any) -> bool:
    return getattr(value, "ndim", 0) == 1 and len(value) > 0 and value.dtype.str == _FLOATS


def _pieces(record: Any) -> list[bytes]:
    """The bytes of a record: every second piece is a float, or those of a vector of float64."""
    layout, pieces = _layout(type(record)), list[bytes]()
    before = layout.head
    for name in layout.names:
        value = getattr(record, name)
        if _is_vector(value):
            opening, closing = _around_vector(name, len(value))
            pieces += before + opening, value.tobytes()
            before = closing
        elif type(value) is float:
            pieces += before + _float_name(name), _FLOAT.pack(value)
            before = b""
        elif value is None or type(value) is str or hasattr(value, "__dataclass_fields__"):
            before += _repeated(name, value)
        else:
            before += message.pack(name) + message.pack(value)
    pieces.append(before)
    return pieces


_FLOAT, _FLOATS = Struct(">d"), "<f8"
"""As msgpack writes a number, and as `message.pack` writes those of an array."""


@cache
def _float_name(name: str) -> bytes:
    return message.pack(name) + message.pack(0.0)[:1]


@lru_cache(maxsize=256)
def _around_vector(name: str, count: int) -> tuple[bytes, bytes]:
    """What `message.pack` writes before and after the numbers of a field that is a vector."""
    data = b"\xff" * (8 * count)
    form = {b"__ndarray__": True, b"data": data, b"dtype": _FLOATS, b"shape": (count,)}
    opening, _, closing = message.pack({name: form})[1:].partition(data)
    return opening, closing


@lru_cache(maxsize=64)
def _repeated(name: str, value: Any) -> bytes:
    """A field that is the same in many records: text, nothing, or a record."""
    packed = message.pack(value) if value is None or type(value) is str else encode(value)
    return message.pack(name) + packed


class _Frame(NamedTuple):
    """All but the numbers in the bytes of a record: the same in the next one of its stream.

    Args:
        split: divides the bytes like `_pieces`.
        constants: the pieces that are no numbers.
        fields: of a record that was read from such bytes.
        numbers: names of the fields that are floats or vectors, and how each is read.
        rotations: names of those that are quaternions.
        normalised: a quaternion in its final form.
        floats: some of the numbers are floats, which may have a range.
    """

    split: Struct
    constants: tuple[bytes, ...]
    fields: dict[str, Any]
    numbers: tuple[tuple[str, Callable[[bytes], Any]], ...]
    rotations: tuple[str, ...]
    normalised: Callable[[str, Any], Any]
    floats: bool


_MAX_FRAMES = 64
_frames: dict[tuple[type, int], _Frame] = {}
_newest: dict[type, tuple[bytes, Any]] = {}
"""The record of each kind that was read last, and its bytes."""


def _keep_frame(record: Any, payload: bytes) -> None:
    """Remember how `payload` is divided, if it is written as we would."""
    from numpy import frombuffer

    from vla_zenoh.types.arrays import unit_quaternion

    pieces = _pieces(record)
    split = Struct("".join(f"{len(piece)}s" for piece in pieces))
    constants = tuple(pieces[::2])
    if split.size != len(payload) or split.unpack(payload)[::2] != constants:
        return
    if len(_frames) >= _MAX_FRAMES:
        _frames.clear()
    names = _layout(type(record)).names
    values = [(name, getattr(record, name)) for name in names]
    numbers = [
        (name, _float if type(value) is float else frombuffer)
        for name, value in values
        if type(value) is float or hasattr(value, "ndim")
    ]
    rotations = tuple(name for name, _ in numbers if name.endswith("quat_xyzw"))
    floats = any(read is _float for _, read in numbers)
    _frames[type(record), len(payload)] = _Frame(
        *(split, constants, dict(values), tuple(numbers), rotations, unit_quaternion, floats)
    )


def _float(number: bytes) -> float:
    return _FLOAT.unpack(number)[0]


def _refilled(kind: type[Record], frame: _Frame, pieces: tuple[bytes, ...]) -> Record:
    """A record like that of the frame with other numbers, which are checked like any others."""
    fields, total = frame.fields.copy(), 0.0
    for (name, read), piece in zip(frame.numbers, pieces, strict=True):
        fields[name] = value = read(piece)
        if not frame.floats:
            total += sum(value.tolist())
    if frame.floats or not isfinite(total):
        return _made(kind, fields)
    try:
        for name in frame.rotations:
            fields[name] = frame.normalised(name, fields[name])
    except RecordError:
        return _made(kind, fields)
    record = object.__new__(kind)
    for name, value in fields.items():
        set_field(record, name, value)
    return record


def _record(kind: type[Record], data: Mapping[Any, Any]) -> Record:
    layout = _layout(kind)
    if data.keys() != layout.known:
        unknown = sorted(shown(name) for name in data if name not in layout.known)
        if unknown:
            raise CodecError("malformed", f"{kind.__name__} has no field {', '.join(unknown[:8])}")
        missing = [name for name in layout.required if name not in data]
        if missing:
            raise CodecError("malformed", f"{kind.__name__} lacks {', '.join(missing)}")
    cause = data.get("cause")
    if cause is not None:
        if not isinstance(cause, dict):
            raise CodecError("malformed", "cause is a map or nothing")
        from vla_zenoh.types import Cause  # brings numpy

        data = {**data, "cause": _record(Cause, cause)}
    return _made(kind, data)


def _made(kind: type[Record], data: Mapping[Any, Any]) -> Record:
    try:
        return kind(**data)
    except RecordError as error:
        raise CodecError("invalid", f"{kind.__name__}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CodecError("malformed", f"{kind.__name__}: {error}") from error


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
        CodecError: ``no_header``, ``malformed``, ``schema`` for another version, or ``invalid`` for
            a value out of range. Fields that a later version may add are ignored.
    """
    if attachment is None:
        raise CodecError("no_header", "the sample has no attachment; streams carry a header there")
    if len(attachment) > MAX_HEADER_BYTES:
        raise CodecError("malformed", f"a header of {len(attachment)} bytes")
    try:
        header = _header_of_ours(attachment)
        if header is not None:
            return header
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
