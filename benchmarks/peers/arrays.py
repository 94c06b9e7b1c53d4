"""Arrays in msgpack as openpi-client writes them, without the checks of our own codec."""

from __future__ import annotations

from typing import Any, cast

import msgpack
import numpy as np


def pack(value: Any) -> bytes:
    """Bytes of maps, lists, numbers and arrays."""
    return cast(bytes, msgpack.packb(value, default=_to_map))


def unpack(payload: bytes) -> Any:
    """Inverse of `pack`; arrays are views."""
    return msgpack.unpackb(payload, object_hook=_from_map)


def _to_map(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    return value


def _from_map(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.ndarray(value[b"shape"], np.dtype(value[b"dtype"]), value[b"data"])
    return value
