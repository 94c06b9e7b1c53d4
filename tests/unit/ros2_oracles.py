"""Other people's CDR for the types of a `Messages`: cyclonedds.idl and pycdr2.

Their classes are made of the same field lists, and random messages of all of them: what is compared
is the encoding, which each of the three does in a way of its own.
"""

from __future__ import annotations

import dataclasses
import types
from typing import Any

import cyclonedds.idl
import cyclonedds.idl.types
import numpy as np
import pycdr2
import pycdr2.types
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from vla_zenoh.interop.ros2.messages import Messages

LIBRARIES = {
    "cyclonedds": (cyclonedds.idl.IdlStruct, cyclonedds.idl.types),
    "pycdr2": (pycdr2.IdlStruct, pycdr2.types),
}
_PLAIN = {"bool": bool, "string": str}
_texts = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20)
MAX_ITEMS = 4
_NO_FIELDS = ("structure_needs_at_least_one_member", "__msgtype__")


class Oracle:
    """One other library's classes for the types of `messages`."""

    def __init__(self, library: str, messages: Messages) -> None:
        self._base, self._types = LIBRARIES[library]
        self._messages = messages
        self._made: dict[str, Any] = {}

    def kind(self, name: str) -> Any:
        if name not in self._made:
            fields = self._messages.fields(name)
            # An empty structure is one byte on ROS 2's wire.
            hints = {field: self._hint(described) for field, described in fields.items()}
            hints = hints or {"structure_needs_at_least_one_member": self._types.uint8}

            def fill(namespace: dict[str, Any]) -> None:
                namespace["__annotations__"] = hints
                namespace["__module__"] = __name__

            typename = name.replace("/", ".")
            made = types.new_class(name.split("/")[-1], (self._base,), {"typename": typename}, fill)
            self._made[name] = dataclasses.dataclass(made)
        return self._made[name]

    def _hint(self, described: Any) -> Any:
        node, what = described
        if node == Nodetype.NAME:
            return self.kind(what)
        if node == Nodetype.BASE:
            name = "uint8" if what[0] in ("byte", "char") else what[0]
            return _PLAIN.get(name) or getattr(self._types, name)
        inner, size = what
        if node == Nodetype.ARRAY:
            return self._types.array[self._hint(inner), size]
        return self._types.sequence[self._hint(inner)]

    def of(self, message: Any) -> Any:
        """The same message in the other library's class."""
        name = message.__msgtype__
        fields = self._messages.fields(name)
        if not fields:
            return self.kind(name)(0)
        return self.kind(name)(*(self._value(getattr(message, field)) for field in fields))

    def _value(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, list):
            return [self._value(item) for item in value]
        return self.of(value) if hasattr(value, "__msgtype__") else value

    def encode(self, message: Any) -> bytes:
        other = self.of(message)
        if self._base is cyclonedds.idl.IdlStruct:
            return other.serialize(use_version_2=False)
        return other.serialize()

    def decode(self, name: str, payload: bytes) -> Any:
        """What the other library reads, as `plain` gives it."""
        return plain(self.kind(name).deserialize(payload))


def plain(value: Any) -> Any:
    """A message of any of the libraries as maps and lists."""
    if dataclasses.is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name))
            for field in dataclasses.fields(value)
            # rosbags counts constants and the type's name among the fields.
            if not field.name.isupper() and field.name not in _NO_FIELDS
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, bytes)):
        return [plain(item) for item in value]
    return value


def random_messages(messages: Messages, name: str) -> st.SearchStrategy[Any]:
    """Messages of one type with random contents."""
    fields = {
        field: _values(messages, described) for field, described in messages.fields(name).items()
    }
    return st.builds(messages.new, st.just(name), **fields)


_RANGES = {
    "byte": (0, 127),
    "char": (0, 255),
    **{f"uint{n}": (0, 2**n - 1) for n in (8, 16, 32, 64)},
    **{f"int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32, 64)},
}


def _values(messages: Messages, described: Any) -> st.SearchStrategy[Any]:
    node, what = described
    if node == Nodetype.NAME:
        return random_messages(messages, what)
    if node == Nodetype.BASE:
        return _scalars(what[0])
    (inner, of), size = what
    low, high = (size, size) if node == Nodetype.ARRAY else (0, MAX_ITEMS)
    items = st.lists(_values(messages, (inner, of)), min_size=low, max_size=high)
    if inner == Nodetype.BASE and of[0] != "string":
        dtype = np.uint8 if of[0] in ("byte", "char") else np.dtype(of[0])
        return items.map(lambda values: np.array(values, dtype))
    return items


def _scalars(name: str) -> st.SearchStrategy[Any]:
    if name == "string":
        return _texts
    if name == "bool":
        return st.booleans()
    if name.startswith("float"):
        return st.floats(allow_nan=False, width=32 if name == "float32" else 64)
    return st.integers(*_RANGES[name])
