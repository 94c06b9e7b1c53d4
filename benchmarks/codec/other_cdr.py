"""CDR by other libraries, cyclonedds and pycdr2, for the message types of a `Messages`.

Their classes are made of the same field lists; the encoding is each library's own.
"""

from __future__ import annotations

import dataclasses
import types
from importlib import import_module
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from vla_zenoh_ros2.messages import Messages

MODULES = {"cyclonedds": "cyclonedds.idl", "pycdr2": "pycdr2"}
"""Library -> its module of structures; that of types lies in it."""
EMPTY = "structure_needs_at_least_one_member"
"""What ROS 2 puts into a message without fields."""
_PLAIN = {"bool": bool, "string": str}


class OtherCdr:
    """One library's classes for the types of `messages`.

    Args:
        library: of `MODULES`.
        messages: with the types.

    Raises:
        ImportError: it is not installed.
    """

    def __init__(self, library: str, messages: Messages) -> None:
        self._base: Any = import_module(MODULES[library]).IdlStruct
        self._types: Any = import_module(f"{MODULES[library]}.types")
        self._options = {"use_version_2": False} if library == "cyclonedds" else {}
        self._messages = messages
        self._made: dict[str, Any] = {}

    def kind(self, name: str) -> Any:
        """The library's class of a ROS type."""
        if name not in self._made:
            fields = self._messages.fields(name)
            hints = {field: self._hint(described) for field, described in fields.items()}
            hints = hints or {EMPTY: self._types.uint8}

            def fill(namespace: dict[str, Any]) -> None:
                namespace["__annotations__"] = hints
                namespace["__module__"] = __name__

            typename = {"typename": name.replace("/", ".")}
            made = types.new_class(name.rsplit("/", 1)[-1], (self._base,), typename, fill)
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
        """The same message in the library's class."""
        name = message.__msgtype__
        fields = self._messages.fields(name)
        if not fields:
            return self.kind(name)(0)
        return self.kind(name)(*(self._value(getattr(message, field)) for field in fields))

    def _value(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            # Of a list of bytes both libraries take ten times as long.
            return value.tobytes() if value.dtype == np.uint8 else value.tolist()
        if isinstance(value, list):
            return [self._value(item) for item in value]
        return self.of(value) if hasattr(value, "__msgtype__") else value

    def encode(self, other: Any) -> bytes:
        """CDR of what `of` made."""
        return other.serialize(**self._options)

    def decode(self, name: str, payload: bytes) -> Any:
        """A message of the library's class."""
        return self.kind(name).deserialize(payload)
