"""Arrays in numpy's .npy form, read without evaluating Python.

numpy's own reader evaluates the header as Python text; this one accepts only the header that numpy
writes for a plain array of numbers, and checks sizes before memory is taken.
"""

from __future__ import annotations

import io
import math
import re
from typing import Any

import numpy as np

from vla_zenoh.errors import PeerError

MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    rb"\{'descr': '([<>|](?:b1|[iu][1248]|f[248]))', 'fortran_order': (True|False), "
    rb"'shape': \(((?:[0-9]{1,10}(?:, ?[0-9]{1,10})*)?),?\), ?\} *\n"
)
MAX_DIMENSIONS = 8


def dump(array: np.ndarray[Any, Any]) -> bytes:
    """As numpy.save writes it."""
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def load(data: Any) -> np.ndarray[Any, Any]:
    """A read-only array.

    Raises:
        PeerError: anything else, such as pickled objects.
    """
    if not isinstance(data, bytes) or data[:6] != MAGIC or len(data) < 12:
        raise _bad("not a .npy file")
    long = data[6] > 1
    start = 12 if long else 10
    end = start + int.from_bytes(data[8:start], "little")
    found = _HEADER.fullmatch(data[start:end])
    if data[6] not in (1, 2) or found is None:
        raise _bad(f"its header is not that of a plain array: {data[start:end][:80]!r}")
    shape = tuple(int(n) for n in found[3].replace(b",", b" ").split())
    dtype = np.dtype(found[1].decode())
    if len(shape) > MAX_DIMENSIONS or math.prod(shape) * dtype.itemsize != len(data) - end:
        raise _bad(f"{len(data) - end} bytes for {dtype} of shape {shape}")
    order = "F" if found[2] == b"True" else "C"
    return np.frombuffer(data, dtype, offset=end).reshape(shape, order=order)


def _bad(why: str) -> PeerError:
    return PeerError("peer_reply", f"an array of the answer cannot be read: {why}")
