"""msgpack with arrays in openpi's form.

An array is a map with the *bytes* keys ``__ndarray__``, ``data``, ``dtype``, ``shape``, a numpy
scalar one with ``__npgeneric__``, ``data``, ``dtype``; this is what openpi-client writes, so its
users' tools read our keys. Other systems' forms are read and written with hooks of their own. Only
arrays of bools, whole numbers, floats and text are carried both ways, nothing is ever unpickled,
and sizes are checked before memory is taken.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from vla_zenoh.errors import CodecError
from vla_zenoh.types import shown

MAX_PAYLOAD_BYTES = 64 * 1024 * 1024
MAX_DEPTH = 32
MAX_ITEMS = 10_000
"""Entries of one list or map. msgpack takes memory for as many as a list claims to have, at each of
its levels, before it sees that they are not there."""
MAX_CONTAINERS = 50_000
"""Lists and maps in one payload: an empty one is a byte on the wire and 64 in memory."""
MAX_DIMENSIONS = 32

_CARRIED_KINDS = "biufSU"
_DTYPE = re.compile(
    r"[<>|=]?(?:b1|[iu][1248]|f[248]|[SU][1-9][0-9]{0,6})"
    r"|bool|u?int(?:8|16|32|64)|float(?:16|32|64)"
)
_MAX_FLOAT_BYTES = 8  # long doubles differ from machine to machine
_LAST_CODE_POINT = 0x10FFFF
_SCALARS: dict[str, tuple[type, ...]] = {
    "b": (bool,),
    "i": (int,),
    "u": (int,),
    "f": (int, float),
    "S": (bytes,),
    "U": (str,),
}


def pack(value: Any, to_map: Callable[[Any], Any] | None = None) -> bytes:
    """Encode maps, lists, text, numbers, bytes, numpy arrays and numpy scalars.

    `to_map` gives the form of an array, see `array_parts`; None: openpi's. Other types raise a
    `CodecError`.
    """
    try:
        packed = msgpack.packb(value, default=to_map or _to_map, use_bin_type=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError("unencodable", f"cannot be written as msgpack: {error}") from error
    assert packed is not None
    return packed


def unpack(payload: bytes, from_map: Callable[[dict[Any, Any]], Any] | None = None) -> Any:
    """Decode what `pack` (or openpi) wrote. Arrays are views into `payload` and read-only.

    `from_map` makes the array of a map that stands for one, see `make_array`; None: openpi's.
    Anything else raises a `CodecError`.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise CodecError(
            "oversize", f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read"
        )
    read = from_map or _from_map
    of_map, of_list = read, None
    if len(payload) > MAX_CONTAINERS:  # fewer bytes cannot hold more; a hook costs time
        count = of_list = _container_counter()
        of_map = lambda found: read(count(found))  # noqa: E731
    try:
        value = msgpack.unpackb(
            payload,
            object_hook=of_map,
            list_hook=of_list,
            ext_hook=_refuse_extension,
            raw=False,
            strict_map_key=True,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
        )
    except CodecError:
        raise
    # ValueError includes text that is not UTF-8; the last one is a map nested deeper than C allows.
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        reason = str(error) or type(error).__name__
        raise CodecError("malformed", f"not valid msgpack: {reason[:200]}") from error
    except msgpack.exceptions.UnpackException as error:
        raise CodecError("malformed", f"not valid msgpack: {error}") from error
    _check_plain(value, MAX_DEPTH)
    return value


def _container_counter() -> Callable[[Any], Any]:
    """A hook that returns its argument, and raises when there are more than `MAX_CONTAINERS`."""
    left = itertools.repeat(None, MAX_CONTAINERS)

    def hook(found: Any) -> Any:
        for _ in left:
            return found
        raise CodecError("malformed", f"more than {MAX_CONTAINERS} lists and maps")

    return hook


_LEAVES = frozenset({bool, bytes, float, int, str, type(None)})


def _check_plain(value: Any, depth: int) -> None:
    if isinstance(value, (dict, list)):
        if depth == 0:
            raise CodecError("malformed", f"nested deeper than {MAX_DEPTH}")
        for item in value.values() if isinstance(value, dict) else value:
            if type(item) not in _LEAVES:
                _check_plain(item, depth - 1)
    elif isinstance(value, msgpack.Timestamp):
        raise CodecError("malformed", "msgpack timestamps are not carried; use nanoseconds")


def _refuse_extension(code: int, data: bytes) -> Any:
    raise CodecError("malformed", f"msgpack extension {code} ({len(data)} bytes) is not carried")


def array_parts(array: np.ndarray[Any, Any]) -> tuple[bytes, str, tuple[int, ...]]:
    """Data, dtype and shape of an array, as every form of it has them.

    Raises:
        TypeError: it is of objects, of times or of long doubles.
    """
    _check_kind(array.dtype)
    return array.tobytes(), array.dtype.str, array.shape


def _to_map(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray):
        data, dtype, shape = array_parts(value)
        return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    if isinstance(value, np.generic):
        _check_kind(value.dtype)
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} has no msgpack form")


def _from_map(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return make_array(value.get(b"data"), value.get(b"dtype"), value.get(b"shape"))
    if b"__npgeneric__" in value:
        return _scalar(value)
    return value


def make_array(data: Any, dtype_name: Any, shape: Any) -> np.ndarray[Any, Any]:
    """A read-only view of received bytes; `CodecError`: dtype or shape do not fit them."""
    dtype = _dtype(dtype_name)
    if not isinstance(data, bytes) or not isinstance(shape, list):
        raise CodecError("malformed", "an array needs bytes 'data' and a list 'shape'")
    if len(shape) > MAX_DIMENSIONS:
        raise CodecError("malformed", f"an array with shape {shown(shape)}")
    entries = 1
    for count in shape:
        if type(count) is not int or count < 0:
            raise CodecError("malformed", f"an array with shape {shown(shape)}")
        entries *= count
    if entries * dtype.itemsize != len(data):
        raise CodecError(
            "malformed", f"an array of {dtype} {shown(tuple(shape))} cannot have {len(data)} bytes"
        )
    if dtype.kind == "U" and data:
        points = np.frombuffer(data, dtype=np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if int(points.max()) > _LAST_CODE_POINT:
            raise CodecError("malformed", "an array of text with characters that do not exist")
    array = np.frombuffer(data, dtype=dtype)
    return array if len(shape) == 1 else array.reshape(shape)


def _scalar(value: dict[Any, Any]) -> np.generic:
    dtype, data = _dtype(value.get(b"dtype")), value.get(b"data")
    if type(data) not in _SCALARS[dtype.kind]:
        raise CodecError("malformed", f"a numpy scalar {dtype} of a {type(data).__name__}")
    try:
        with np.errstate(over="raise"):
            return dtype.type(data)
    except (TypeError, ValueError, OverflowError, FloatingPointError) as error:
        raise CodecError("malformed", f"a numpy scalar {dtype}: {error}") from error


def _dtype(name: Any) -> np.dtype[Any]:
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise CodecError("malformed", f"an array with dtype {shown(name)} is not carried")
    return np.dtype(name)


def _check_kind(dtype: np.dtype[Any]) -> None:
    too_long = dtype.kind == "f" and dtype.itemsize > _MAX_FLOAT_BYTES
    if dtype.kind not in _CARRIED_KINDS or dtype.itemsize == 0 or too_long:
        raise TypeError(f"arrays of {dtype} are not carried")
