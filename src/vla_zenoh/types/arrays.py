"""Field types of records that are arrays in the program and lists of numbers on the wire."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.form import MAX_ENTRIES, MAX_NAMES, Finite, Name, Wire

FloatArray = NDArray[np.float64]

QUATERNION_NORM_TOLERANCE = 1e-3
_UNIT = 1e-15
"""Nearer to one than this a norm is not improved by dividing."""
MAX_MEASURE = 1e6
"""Of a measured or commanded quantity in SI units: more is a wrong unit, or broken."""
MAX_VECTOR = 10_000
MAX_STEPS, MAX_COLUMNS = 1000, 100
_MAX_FLOAT32 = float(np.finfo(np.float32).max)


def _array(name: str, value: Any) -> FloatArray:
    array = np.array(value, np.float64)
    array.setflags(write=False)
    return array


def unit_quaternion(name: str, value: Any) -> FloatArray:
    """Four numbers x, y, z, w, normalised and read-only.

    Raises:
        RecordError: they are far from unit.
    """
    norm = math.hypot(*value)
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise RecordError(f"{name} has norm {norm:.6g}, allowed: a unit quaternion x, y, z, w")
    if abs(norm - 1.0) > _UNIT:
        value = np.asarray(value) / norm
    return _array(name, value)


def _positions(name: str, value: Any) -> FloatArray:
    return _array(name, np.reshape(value, (-1, 3)))


def _quaternions(name: str, value: Any) -> FloatArray:
    rows = [unit_quaternion(f"{name}[{index}]", row) for index, row in enumerate(value)]
    return _array(name, np.reshape(rows, (-1, 4)))


def _table(name: str, value: Any) -> NDArray[np.float32]:
    if any(len(row) != len(value[0]) for row in value):
        raise RecordError(f"{name} has rows of several lengths, allowed: rows of one length")
    table = np.array(value, np.float32)
    table.setflags(write=False)
    return table


def _vectors(name: str, value: Any) -> dict[str, FloatArray]:
    return {key: _array(key, numbers) for key, numbers in value.items()}


_Measure = Annotated[float, Meta(ge=-MAX_MEASURE, le=MAX_MEASURE)]


def _list(of: Any, least: int, most: int) -> Any:
    return Annotated[list[of], Meta(min_length=least, max_length=most)]


_Three, _Four, _Six = (_list(_Measure, size, size) for size in (3, 4, 6))
_Any = _list(Finite, 0, MAX_VECTOR)
_Number32 = Annotated[float, Meta(ge=-_MAX_FLOAT32, le=_MAX_FLOAT32)]
_Rows = _list(_list(_Number32, 1, MAX_COLUMNS), 1, MAX_STEPS)

Vector3 = Annotated[FloatArray, Wire(_Three, _array)]
Vector6 = Annotated[FloatArray, Wire(_Six, _array)]
Quaternion = Annotated[FloatArray, Wire(_Four, unit_quaternion)]
"""x, y, z, w; within `QUATERNION_NORM_TOLERANCE` of unit, and made unit."""
PerJoint = Annotated[FloatArray, Wire(_list(_Measure, 1, MAX_NAMES), _array)]
"""One number per joint."""
Vector = Annotated[FloatArray, Wire(_Any, _array)]
"""Any number of finite numbers."""
Positions = Annotated[FloatArray, Wire(_list(_Three, 0, MAX_ENTRIES), _positions)]
Quaternions = Annotated[FloatArray, Wire(_list(_Four, 0, MAX_ENTRIES), _quaternions)]
Steps = Annotated[NDArray[np.float32], Wire(_Rows, _table)]
"""(H, D): rows of numbers, one row a step."""
Vectors = Annotated[
    Mapping[str, FloatArray],
    Wire(Annotated[dict[Name, _Any], Meta(max_length=MAX_ENTRIES)], _vectors),
]


@cache
def _per_joint(kind: type[Any]) -> tuple[str, ...]:
    """The fields of a record that are `PerJoint`, or None in its place."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(name for name, hint in hints.items() if PerJoint in (hint, *get_args(hint)))


def check_per_joint(record: Any) -> None:
    """Raise a `RecordError` unless each field that is `PerJoint` has one entry for each of the
    record's `names`, which differ."""
    joints = record.names
    if not joints or len(set(joints)) != len(joints):
        raise RecordError(f"names is {joints}, allowed: at least one name, none of them twice")
    for name in _per_joint(type(record)):
        value = getattr(record, name)
        if value is not None and len(value) != len(joints):
            raise RecordError(
                f"{name} has {len(value)} numbers, allowed: one for each of the {len(joints)} names"
            )
