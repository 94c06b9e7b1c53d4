"""Our records as ROS 2 messages: names, definitions, CDR. Made of the dataclasses themselves.

A record `PoseState` is the message ``vla_zenoh_msgs/msg/PoseState``: a ``std_msgs/Header`` and
then the record's own fields, in their order and with their names:

==========================  ===============================================================
field of the record          field of the message
==========================  ===============================================================
bool, int, float, str        bool, int64, float64, string
tuple of texts               string[]
array                        float64[] or float32[]; with more than one axis, its shape in
                             ``<name>_shape``
map                          string, JSON
array or None                empty when None
number or `Cause`, or None   a list of at most one
==========================  ===============================================================

`ModelSpec` is nested deeper than a message is read: ``string spec``, JSON.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk, Cause, InferenceDebug, ObjectPoses

PACKAGE = "vla_zenoh_msgs"
HEADER = "std_msgs/Header header"
_SHAPED = {
    (ActionChunk, "steps"),
    (InferenceDebug, "steps"),
    (ObjectPoses, "position_m"),
    (ObjectPoses, "quat_xyzw"),
}
_PLAIN = {bool: "bool", int: "int64", float: "float64", str: "string"}
_NO_INTEGER = -(2**63)


class Unfit(ValueError):
    """A payload that is no record of its kind: kept as bytes."""


class Field(NamedTuple):
    """One field of a record and its counterpart in the message.

    Args:
        name: of both.
        ros: type in the message.
        shaped: another field says the shape.
        default: value of a payload without it, `dataclasses.MISSING` where it must be there.
        write: value in the payload to value in the message; raises `Unfit`.
        read: the way back.
    """

    name: str
    ros: str
    shaped: bool
    default: Any
    write: Callable[[Any], Any]
    read: Callable[[Any], Any]


def type_name(kind: type) -> str:
    """ROS name of a record's message."""
    return f"{PACKAGE}/msg/{kind.__name__}"


def definition(kind: type, *, header: bool = True) -> str:
    """Text of a record's message."""
    lines = [HEADER] if header else []
    for field in fields_of(kind):
        lines.append(f"{field.ros} {field.name}")
        if field.shaped:
            lines.append(f"uint32[] {field.name}_shape")
    return "\n".join(lines) + "\n"


SAMPLE_NAME = f"{PACKAGE}/msg/Sample"
SAMPLE = (
    f"{HEADER}\n"
    "# What a key said and no other message can hold: the bytes, and how they were labelled.\n"
    "string encoding\nbool has_attachment\nuint8[] attachment\nuint8[] payload\n"
)


@cache
def fields_of(kind: type) -> tuple[Field, ...]:
    """Fields of a record, in order."""
    if kind is ModelSpec:
        return (Field("spec", "string", False, dataclasses.MISSING, _to_json, json.loads),)
    hints = typing.get_type_hints(kind)
    return tuple(
        _field(kind, field.name, hints[field.name], _default(field))
        for field in dataclasses.fields(kind)
    )


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _field(kind: type, name: str, hint: Any, default: Any) -> Field:
    optional = typing.get_origin(hint) is types.UnionType
    if optional:
        hint = next(part for part in typing.get_args(hint) if part is not types.NoneType)
    origin = typing.get_origin(hint)
    if origin is np.ndarray:
        single = "float32" in str(hint)
        shaped = (kind, name) in _SHAPED
        dtype = np.dtype("<f4" if single else "<f8")
        write, read = _array(dtype, 2 if shaped else 1, optional), _array_back(optional)
        return Field(name, f"{dtype.name}[]", shaped, default, write, read)
    if origin is tuple:
        return Field(name, "string[]", False, default, _texts, list)
    if origin is not None and issubclass(origin, Mapping):
        return Field(name, "string", False, default, _to_json, json.loads)
    if hint is Cause:
        ros, write, read = f"{PACKAGE}/Cause[<=1]", _plain_map(Cause), _plain_map_back(Cause)
        return Field(name, ros, False, default, _perhaps(write, list), _perhaps_back(read))
    ros, write = _PLAIN[hint], _value(hint)
    if optional:
        as_list = partial(np.array, dtype=ros) if hint in (int, float) else list
        return Field(
            name, f"{ros}[<=1]", False, default, _perhaps(write, as_list), _perhaps_back(hint)
        )
    return Field(name, ros, False, default, write, hint)


def _value(hint: type) -> Callable[[Any], Any]:
    def write(value: Any) -> Any:
        if hint is float and type(value) is int:
            value = float(value)
        if type(value) is not hint or (hint is int and not _NO_INTEGER <= value < -_NO_INTEGER):
            raise Unfit
        return value

    return write


def _array(dtype: np.dtype[Any], axes: int, optional: bool) -> Callable[[Any], Any]:
    def write(value: Any) -> Any:
        if value is None and optional:
            return np.zeros(0, dtype)
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or array.ndim != axes or (optional and not array.size):
            if array.size or array.ndim > axes or optional:
                raise Unfit
            array = array.reshape((0,) * axes)
        return np.ascontiguousarray(array, dtype)

    return write


def _array_back(optional: bool) -> Callable[[Any], Any]:
    return lambda value: None if optional and not len(value) else value


def _texts(value: Any) -> list[str]:
    if not isinstance(value, (list, tuple)) or not all(type(item) is str for item in value):
        raise Unfit
    return list(value)


def _to_json(value: Any) -> str:
    if not isinstance(value, Mapping):
        raise Unfit
    try:
        return json.dumps(value)
    except (TypeError, ValueError) as error:
        raise Unfit from error


def _perhaps(write: Callable[[Any], Any], as_list: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: as_list([] if value is None else [write(value)])


def _perhaps_back(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: read(value[0]) if len(value) else None


def _plain_map(kind: type) -> Callable[[Any], Any]:
    def write(value: Any) -> Any:
        if not isinstance(value, dict) or set(value) != {f.name for f in fields_of(kind)}:
            raise Unfit
        return {field.name: field.write(value[field.name]) for field in fields_of(kind)}

    return write


def _plain_map_back(kind: type) -> Callable[[Any], Any]:
    return lambda value: {f.name: f.read(getattr(value, f.name)) for f in fields_of(kind)}
