"""How a record is declared and checked: field types with their limits, and the base class.

A record is a dataclass. Its fields say what travels, plain msgpack, and msgspec checks types,
lengths and ranges in C: of a record that is built as of one that is read, by the same decoder. A
field that is an array in the program is a list of numbers on the wire, see `Wire`.

Without numpy, which a command that only drives does not load; array fields are in ``arrays.py``.
"""

from __future__ import annotations

import dataclasses
import re
import reprlib
import sys
from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, MsgspecError, Raw, ValidationError, inspect, msgpack

from vla_zenoh.errors import RecordError

MAX_SHOWN = 300
MAX_SHOWN_BYTES = 65_536
MAX_ENTRIES = MAX_NAMES = 1024
MAX_TEXT = 4096
MAX_DETAIL_TEXT = 65_536
MAX_WHOLE = 2**63 - 1

Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""Any number but NaN and the infinities."""
Count = Annotated[int, Meta(ge=0, le=MAX_WHOLE)]
"""A whole number from 0, also a time in nanoseconds."""
Name = Annotated[str, Meta(max_length=128)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
Names = Annotated[tuple[Name, ...], Meta(max_length=MAX_NAMES)]

_Key = Annotated[str, Meta(max_length=256)]
Numbers = Annotated[Mapping[_Key, Finite], Meta(max_length=MAX_ENTRIES)]
Counts = Annotated[Mapping[_Key, Count], Meta(max_length=MAX_ENTRIES)]
Pairs = Annotated[Mapping[_Key, tuple[Finite, Finite]], Meta(max_length=MAX_ENTRIES)]


class Wire(NamedTuple):
    """Annotation of a field that is another type in the program than on the wire.

    Args:
        form: the type that msgspec checks.
        make: the field's value of its name and what was read; may raise a `RecordError`.
    """

    form: Any
    make: Callable[[str, Any], Any]


def as_read(name: str, value: Any) -> Any:
    """`Wire.make` of a field that stays as it was read."""
    return value


_Whole = Annotated[int, Meta(ge=-(2**63), le=MAX_WHOLE)]
_DetailText = Annotated[str, Meta(max_length=MAX_DETAIL_TEXT)]
_Leaf = bool | _Whole | Finite | _DetailText | None


def _holding(inner: Any) -> Any:
    """A leaf, or a list or map of `inner`."""
    several = Annotated[list[inner], Meta(max_length=MAX_ENTRIES)]
    return _Leaf | several | _map_of(inner)


def _map_of(inner: Any) -> Any:
    return Annotated[dict[_Key, inner], Meta(max_length=MAX_ENTRIES)]


Details = Annotated[Mapping[str, Any], Wire(_map_of(_holding(_holding(_holding(_Leaf)))), as_read)]
"""Text, numbers, bools and None by name, in lists and maps that are nested three deep."""


class Record:
    """Base of every record: a frozen dataclass whose fields are checked and final once it exists.

    Bad values raise a `RecordError` that names field, value and what is allowed. A subclass adds
    what its field types cannot say in `_check`.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        form = form_of(type(self))
        form.settle(self, form.checked({name: getattr(self, name) for name in form.names}))

    def _check(self) -> None:
        """Raise a `RecordError` where fields contradict each other."""


class Form:
    """The wire form of one kind of record.

    Args:
        struct: what msgspec checks.
        names, required: of its fields.
        parts: field -> form of the record that it holds.
    """

    def __init__(self, kind: type[Any]) -> None:
        hints = get_type_hints(kind, include_extras=True)
        fields = dataclasses.fields(kind)
        wires = {field.name: _wire(hints[field.name]) for field in fields}
        self.kind = kind
        self.parts = {field.name: part for field in fields if (part := _part(hints[field.name]))}
        self.names = tuple(wires)
        self.required = [each.name for each in fields if _default(each) is msgspec.NODEFAULT]
        self.struct = msgspec.defstruct(
            kind.__name__,
            [(field.name, wires[field.name].form, _default(field)) for field in fields],
            namespace={"__doc__": kind.__doc__},
        )
        self._plain = [name for name, wire in wires.items() if wire.make is as_read]
        self._makers = [(n, wire.make) for n, wire in wires.items() if wire.make is not as_read]
        self._decoder = msgpack.Decoder(self.struct)

    def read(self, payload: bytes) -> Any:
        """The record in a payload; raises a `RecordError`, or msgspec's own error if it is not such
        a map."""
        try:
            found = self._decoder.decode(payload)
        except ValidationError as error:
            fields = msgpack.decode(payload, type=dict[str, Raw])
            raise RecordError(self._why(error, _Shown(fields))) from error
        return self.record(found)

    def record(self, found: Any) -> Any:
        """The record of a checked `struct`."""
        record = object.__new__(self.kind)
        self.settle(record, found)
        return record

    def settle(self, record: Any, found: Any) -> None:
        """Put fields into a record in their final form."""
        for name in self._plain:
            object.__setattr__(record, name, getattr(found, name))
        for name, make in self._makers:
            object.__setattr__(record, name, make(name, getattr(found, name)))
        record._check()

    def checked(self, fields: Mapping[str, Any]) -> Any:
        """The `struct` of the values of a record that is being built."""
        try:
            payload = encode_plain(fields)
        except ENCODING_ERRORS as error:
            raise RecordError(self._not_encoded(fields, error)) from error
        try:
            return self._decoder.decode(payload)
        except ValidationError as error:
            raise RecordError(self._why(error, fields)) from error

    def _not_encoded(self, fields: Mapping[str, Any], whole: Exception) -> str:
        for name, value in fields.items():
            try:
                encode_plain(value)
            except ENCODING_ERRORS as error:
                allowed = described(_field(inspect.type_info(self.struct), name))
                return f"{name} is {shown(value)}, allowed: {allowed} ({error})"
        return str(whole)

    def _why(self, error: ValidationError, fields: Mapping[str, Any]) -> str:
        """Names the field, its value and what is allowed."""
        what, _, where = str(error).partition(" - at ")
        value, node = fields, inspect.type_info(self.struct)
        path = ""
        for name, index in _PATH.findall(where):
            if name:
                path += f".{name}" if path else name
                value, node = _item(value, name), _field(node, name)
            elif index == "...":
                entry = self._wrong_entry(path, value)
                path += f".{entry}"
                value, node = _item(value, entry), _inner(node)
                break
            else:
                path += f"[{index}]"
                value, node = _item(value, int(index)), _inner(node, int(index))
        if where.startswith("`key`"):
            return f"a name in {path} is wrong: {what}; names have at most 256 characters"
        if what.startswith("Object missing"):
            return f"{path} lacks {what.split('`')[1]}"
        return f"{path} is {shown(value)}, allowed: {described(node)}"

    def _wrong_entry(self, field: str, entries: Any) -> str:
        """Name of the entry of a map that is not allowed."""
        for name, value in entries.items() if isinstance(entries, Mapping) else ():
            try:
                self._decoder.decode(encode_plain({field: {name: value}}))
            except MsgspecError as error:  # also that other fields are missing
                if f"$.{field}" in str(error):
                    return name
        return "..."


@cache
def form_of(kind: type[Any]) -> Form:
    """The wire form of a kind of record."""
    return Form(kind)


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return msgspec.field(default_factory=field.default_factory)
    return msgspec.NODEFAULT


def _wire(hint: Any) -> Wire:
    """Wire form of a field, and how its value is made."""
    if type(None) in get_args(hint):
        inner = _wire(get_args(hint)[0])
        if inner.make is as_read:
            return Wire(inner.form | None, as_read)
        return Wire(inner.form | None, lambda name, v: None if v is None else inner.make(name, v))
    part = _part(hint)
    if part is not None:
        return Wire(part.struct, lambda name, found: part.record(found))
    if get_origin(hint) is Annotated:
        for given in hint.__metadata__:
            if isinstance(given, Wire):
                return given
    return Wire(hint, as_read)


def _part(hint: Any) -> Form | None:
    """Form of the record, if that is what a field holds."""
    kinds = [kind for kind in (hint, *get_args(hint)) if isinstance(kind, type)]
    record = next((kind for kind in kinds if issubclass(kind, Record)), None)
    return None if record is None else form_of(record)


# -- bytes ------------------------------------------------------------------------------------
ENCODING_ERRORS = (TypeError, ValueError, OverflowError, RecursionError)
"""Errors of `encode_plain`."""


def _plain(value: Any) -> Any:
    """Numbers and arrays of numpy and others as Python's."""
    tolist = getattr(value, "tolist", None)
    if tolist is None:
        raise TypeError(f"{type(value).__name__} has no msgpack form")
    return tolist()


encode_plain = msgpack.Encoder(enc_hook=_plain).encode
"""msgpack of plain values, records and arrays; arrays become lists."""


class _Shown(Mapping[str, Any]):
    """Values of undecoded fields, for an error message."""

    def __init__(self, fields: Mapping[str, Raw]) -> None:
        self._fields = fields

    def __getitem__(self, name: str) -> Any:
        raw = memoryview(self._fields[name])
        if len(raw) > MAX_SHOWN_BYTES:
            return f"{len(raw)} bytes"
        try:
            return msgpack.decode(raw)
        except (MsgspecError, ValueError, RecursionError) as error:
            return str(error)

    def __iter__(self) -> Any:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)


# -- words ------------------------------------------------------------------------------------
_PATH = re.compile(r"\.(\w+)|\[(\d+|\.\.\.)\]")


def shown(value: Any) -> str:
    """`value` in short, for an error message: it may be huge, nested, or refuse to be printed."""
    if isinstance(value, (str, bytes)):
        value = value[:80]
    return reprlib.repr(getattr(value, "tolist", lambda: value)())[:MAX_SHOWN]


def _item(value: Any, at: Any) -> Any:
    """A part of what could be anything, for an error message."""
    try:
        return getattr(value, at) if isinstance(value, Record) else value[at]
    except (LookupError, TypeError, AttributeError):
        return value


def _known(node: Any) -> Any:
    """Of an optional type the one it is if given."""
    if isinstance(node, inspect.UnionType):
        return next(kind for kind in node.types if not isinstance(kind, inspect.NoneType))
    return node


def _field(node: Any, name: str) -> Any:
    fields = getattr(_known(node), "fields", ())
    return next((field.type for field in fields if field.name == name), node)


def _inner(node: Any, index: int = 0) -> Any:
    node = _known(node)
    if isinstance(node, inspect.DictType):
        return node.value_type
    if isinstance(node, inspect.TupleType):
        return node.item_types[index]
    return getattr(node, "item_type", node)


def described(node: Any) -> str:
    """What a type allows, in words."""
    match node:
        case inspect.FloatType() if node.le == sys.float_info.max:
            return "a finite number"
        case inspect.FloatType():
            return f"a number from {bound_text(node.ge)} to {bound_text(node.le)}"
        case inspect.IntType():
            most = "2^63 - 1" if node.le == MAX_WHOLE else node.le
            least = "-2^63" if node.ge == -(2**63) else node.ge
            return f"a whole number from {least} to {most}"
        case inspect.StrType():
            return f"text of at most {node.max_length} characters"
        case inspect.BoolType():
            return "true or false"
        case inspect.NoneType():
            return "null"
        case inspect.LiteralType():
            return " or ".join(map(str, node.values))
        case inspect.TupleType():
            return f"a list of {len(node.item_types)}, each {described(node.item_types[0])}"
        case inspect.ListType() | inspect.VarTupleType():
            return f"a list of {_length(node)}, each {described(node.item_type)}"
        case inspect.DictType():
            return f"a map of {_length(node)} names, each {described(node.value_type)}"
        case inspect.StructType():
            return f"a {node.cls.__name__}"
        case inspect.UnionType():
            if len(node.types) > 2:
                return (
                    "text, numbers, true, false and null, in lists and maps nested 3 deep at most"
                )
            return " or ".join(described(kind) for kind in reversed(node.types))
        case _:
            return str(node)


def bound_text(value: Any) -> str:
    """A bound as a person writes it: -1e6, not -1e+06."""
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")


def _length(node: Any) -> str:
    least, most = node.min_length or 0, node.max_length
    if least == most:
        return str(most)
    return f"{least} to {most}"
