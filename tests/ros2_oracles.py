"""Random ROS 2 messages of any type, and messages of any library as plain maps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from vla_zenoh_ros2.messages import Messages

from benchmarks.codec.other_cdr import EMPTY

_texts = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20)
MAX_ITEMS = 4
_NO_FIELDS = (EMPTY, "__msgtype__")


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
