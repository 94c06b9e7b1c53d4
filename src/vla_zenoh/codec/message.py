"""msgpack with arrays in openpi's form.

An array is a map with the *bytes* keys ``__ndarray__``, ``data``, ``dtype``, ``shape``, a numpy
scalar one with ``__npgeneric__``, ``data``, ``dtype``; this is what openpi-client writes, so its
users' tools read our keys. Object, void and complex types are refused both ways, nothing is ever
unpickled, and sizes are checked before memory is taken.
"""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np

from vla_zenoh.errors import CodecError

MAX_PAYLOAD_BYTES = 64 * 1024 * 1024
MAX_DEPTH = 32
_REFUSED_KINDS = "OVc"


def pack(value: Any) -> bytes:
    """Encode maps, lists, text, numbers, bytes, numpy arrays and numpy scalars.

    Raises:
        CodecError: a value of another type.
    """
    try:
        packed = msgpack.packb(value, default=_to_map, use_bin_type=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError("unencodable", f"cannot be written as msgpack: {error}") from error
    assert packed is not None
    return packed


def unpack(payload: bytes) -> Any:
    """Decode what `pack` (or openpi) wrote.

    Raises:
        CodecError: whatever else the bytes are.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise CodecError(
            "oversize", f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read"
        )
    try:
        return msgpack.unpackb(
            payload, object_hook=_from_map, raw=False, strict_map_key=False, use_list=True
        )
    except CodecError:
        raise
    except (ValueError, TypeError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise CodecError("malformed", f"not valid msgpack: {error or type(error).__name__}") from error
    except msgpack.exceptions.UnpackException as error:
        raise CodecError("malformed", f"not valid msgpack: {error}") from error


def _to_map(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray):
        _check_kind(value.dtype)
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        _check_kind(value.dtype)
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} has no msgpack form")


def _from_map(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        dtype = _dtype(value)
        data, shape = value.get(b"data"), value.get(b"shape")
        if not isinstance(data, bytes) or not isinstance(shape, (list, tuple)):
            raise CodecError("malformed", "an array needs bytes 'data' and a list 'shape'")
        if len(shape) > MAX_DEPTH or not all(
            isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in shape
        ):
            raise CodecError("malformed", f"an array with shape {shape!r}")
        if math.prod(shape) * dtype.itemsize != len(data):
            raise CodecError(
                "malformed", f"an array of {dtype} {tuple(shape)} cannot have {len(data)} bytes"
            )
        return np.frombuffer(data, dtype=dtype).reshape(shape)
    if b"__npgeneric__" in value:
        try:
            return _dtype(value).type(value.get(b"data"))
        except (TypeError, ValueError, OverflowError) as error:
            raise CodecError("malformed", f"not a numpy scalar: {error}") from error
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    name = value.get(b"dtype")
    if not isinstance(name, str) or len(name) > 16:
        raise CodecError("malformed", f"an array with dtype {name!r}")
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError) as error:
        raise CodecError("malformed", f"an array with dtype {name!r}") from error
    try:
        _check_kind(dtype)
    except TypeError as error:
        raise CodecError("malformed", str(error)) from error
    return dtype


def _check_kind(dtype: np.dtype[Any]) -> None:
    if dtype.kind in _REFUSED_KINDS or dtype.itemsize == 0:
        raise TypeError(f"arrays of {dtype} are not carried")
