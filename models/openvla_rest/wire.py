"""OpenVLA's wire: JSON over ``POST /act``, arrays as json_numpy writes them.

An array is ``{"__numpy__": base64, "dtype": "<f4", "shape": [..]}``. The answer is an array (7,),
for OFT a list of them. Where json_numpy is not wanted on the wire, the request is
``{"encoded": "<the same as text>"}`` and the answer a text with JSON in it. A server that fails
answers 200 with the text ``error``.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from vla_zenoh_policy_servers.presets import BRIDGE, OPENS_AT_1, OSC, STATE8, Presets

from vla_zenoh.errors import PeerError
from vla_zenoh.types import shown

PORT = 8000
PATH = "/act"
MAX_BYTES = 16 * 1024 * 1024
"""Of an answer; a chunk of actions is a few kilobytes."""
_DTYPE = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f[248])")

PRESETS: Presets = {
    "bridge": {
        "map": "image=camera:front, instruction=prompt",
        **BRIDGE,
        "horizon": "1",
    },
    "libero": {
        "map": "image=camera:front, instruction=prompt",
        **OSC,
        **OPENS_AT_1,
        "horizon": "1",
    },
    "oft_libero": {
        "map": "full_image=camera:front, wrist_image=camera:wrist, "
        f"state={STATE8}, instruction=prompt",
        **OSC,
        **OPENS_AT_1,
        "horizon": "8",
    },
}


def pack(value: Any) -> str:
    """JSON with arrays."""

    def as_map(array: Any) -> Any:
        if isinstance(array, (np.ndarray, np.generic)):
            return {
                "__numpy__": base64.b64encode(array.tobytes()).decode("ascii"),
                "dtype": array.dtype.str,
                "shape": list(array.shape),
            }
        raise TypeError(f"{type(array).__name__} has no form in JSON")

    return json.dumps(value, default=as_map)


def unpack(text: bytes | str) -> Any:
    """Inverse of `pack`.

    Raises:
        PeerError: it is anything else.
    """
    if len(text) > MAX_BYTES:
        raise PeerError("peer_reply", f"an answer of {len(text)} bytes, at most {MAX_BYTES}")
    try:
        return json.loads(text, object_hook=_from_map, parse_constant=_no_constant)
    except PeerError:
        raise
    except (ValueError, RecursionError) as error:
        raise PeerError("peer_reply", f"the answer is not JSON: {shown(str(error))}") from error


def _no_constant(name: str) -> NoReturn:
    raise PeerError("peer_reply", f"the answer holds {name}")


def _from_map(value: dict[str, Any]) -> Any:
    if "__numpy__" not in value:
        return value
    data, name, shape = value["__numpy__"], value.get("dtype"), value.get("shape")
    if not isinstance(data, str) or not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise PeerError("peer_reply", f"an array with dtype {shown(name)}")
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise PeerError("peer_reply", f"an array with shape {shown(shape)}")
    try:
        raw = base64.b64decode(data, validate=True)
    except (binascii.Error, ValueError) as error:
        raise PeerError("peer_reply", f"an array that is not base64: {error}") from error
    dtype = np.dtype(name)
    if len(shape) > 8 or math.prod(shape) * dtype.itemsize != len(raw):
        raise PeerError("peer_reply", f"an array of {dtype} {shown(shape)} in {len(raw)} bytes")
    return np.frombuffer(raw, dtype).reshape(shape)


def request(fields: Mapping[str, Any], unnorm_key: str = "", *, encoded: bool = False) -> bytes:
    """The body of a request.

    Args:
        fields: names with images, arrays and text.
        unnorm_key: statistics for the server to unnormalise with; empty: its own choice.
        encoded: as a text within JSON.
    """
    body = pack({**fields, **({"unnorm_key": unnorm_key} if unnorm_key else {})})
    return (json.dumps({"encoded": body}) if encoded else body).encode()


def read_answer(status: int, body: bytes) -> Any:
    """An array or a list of arrays.

    Raises:
        PeerError: the server failed, or it is neither.
    """
    if status != 200:
        raise PeerError("peer_error", f"the server answers {status}: {shown(body)}")
    answer = unpack(body)
    if isinstance(answer, str) and answer != "error":
        answer = unpack(answer)  # the double encoding
    if isinstance(answer, (str, dict)):
        raise PeerError("peer_error", f"the server says {shown(answer)}; its log says why")
    if isinstance(answer, list):
        try:
            return np.asarray(answer)
        except (ValueError, OverflowError) as error:
            raise PeerError("peer_reply", f"steps of different lengths: {error}") from error
    return answer
