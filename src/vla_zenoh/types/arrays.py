"""Checks of record fields that are arrays, see ``stream.py``."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.stream import set_field, shown

FloatArray = NDArray[np.float64]
Record = TypeVar("Record")
_FLOAT64 = np.dtype(np.float64)

QUATERNION_NORM_TOLERANCE = 1e-3
MAX_VECTOR, MAX_CHUNK_NUMBERS = 10_000, 100_000
FEW = 64
"""Records are made at every tick: on so few numbers Python is faster than numpy."""
_NUMBER_KINDS = "iuf"


def numbers(name: str, value: ArrayLike) -> NDArray[Any]:
    """`value` as an array of numbers; text, truth values and objects are rejected."""
    if isinstance(value, np.ndarray) and value.dtype.kind in _NUMBER_KINDS:
        return value
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"{name} is not a list of numbers: {error}") from error
    if array.dtype.kind not in _NUMBER_KINDS or _holds_bool(value):
        raise RecordError(f"{name} is not a list of numbers: {shown(value)}")
    return array


def _holds_bool(value: Any) -> bool:
    """Whether a list that became an array of numbers had a truth value among them."""
    if isinstance(value, (list, tuple)):
        return any(_holds_bool(item) for item in value)
    return isinstance(value, (bool, np.bool_))


def vector(name: str, value: ArrayLike, size: int | None = None) -> FloatArray:
    """Copy `value` into a finite, read-only float64 vector of `size` (None: any size)."""
    if (
        type(value) is np.ndarray
        and value.dtype is _FLOAT64
        and type(value.base) is bytes  # which never change
        and value.shape == (size,)
        and math.isfinite(sum(value.tolist()))
    ):
        return value  # of a record that was just read: a short cut
    array = numbers(name, value)
    if array.ndim != 1 or (size is not None and array.shape[0] != size):
        wanted = "(n,)" if size is None else f"({size},)"
        raise RecordError(f"{name} has shape {array.shape}, wanted {wanted}")
    if len(array) > MAX_VECTOR:
        raise RecordError(f"{name} has {len(array)} numbers, at most {MAX_VECTOR} are allowed")
    if type(array.base) is not bytes or array.dtype is not _FLOAT64:  # bytes never change
        array = np.array(array, dtype=np.float64, order="C")
        array.setflags(write=False)
    if not is_finite(array):
        raise RecordError(f"{name} is not finite: {shown(array.tolist())}")
    return array


def float32_table(name: str, value: ArrayLike) -> NDArray[np.float32]:
    """Copy `value` into a finite, read-only float32 array (H, D) of `MAX_CHUNK_NUMBERS` at most."""
    array = numbers(name, value)
    if array.ndim != 2 or 0 in array.shape:
        raise RecordError(f"{name} has shape {array.shape}, wanted (H, D)")
    if array.size > MAX_CHUNK_NUMBERS:
        raise RecordError(f"{name} has {array.size} numbers, at most {MAX_CHUNK_NUMBERS}")
    table = to_float32(array)
    if not is_finite(table):
        raise RecordError(f"{name} holds NaN or infinity")
    table.setflags(write=False)
    return table


def to_float32(array: NDArray[Any]) -> NDArray[np.float32]:
    """Copy numbers into float32, row by row; what float32 cannot hold becomes infinite."""
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float32, order="C")


def is_finite(array: NDArray[Any]) -> bool:
    """Whether no number of an array is NaN or infinite."""
    if array.size <= FEW:
        values = array.tolist() if array.ndim == 1 else array.ravel().tolist()
        return math.isfinite(sum(values)) or all(map(math.isfinite, values))  # a sum may overflow
    return bool(np.isfinite(array).all())


def unit_quaternion(name: str, value: ArrayLike) -> FloatArray:
    """Like `vector` for four numbers x, y, z, w; normalised, rejected when far from unit."""
    array = vector(name, value, 4)
    norm = math.hypot(*array.tolist())
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise RecordError(f"{name} has norm {norm:.6g}, wanted a unit quaternion x, y, z, w")
    if norm == 1.0:
        return array
    array = array / norm
    array.setflags(write=False)
    return array


def computed(kind: type[Record], *values: Any) -> Record:
    """A record of values that this program has just computed, all in their final form.

    Only whether vectors are finite is checked, and they are not copied: a record for every tick.
    """
    record, total = object.__new__(kind), 0.0
    for name, value in zip(kind.__match_args__, values, strict=True):  # pyright: ignore
        if type(value) is np.ndarray:
            total += sum(value.tolist())
            value.setflags(write=False)
        set_field(record, name, value)
    return record if math.isfinite(total) else kind(*values)  # which names what is not finite
