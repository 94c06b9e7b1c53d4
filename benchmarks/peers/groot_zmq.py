"""GR00T's way: ZeroMQ REQ/REP, requests and .npy arrays in msgpack as its N1.6 server reads."""

from __future__ import annotations

import io
import time
from typing import Any, cast

import msgpack
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.peers import ACTION, ADDRESS, PROMPT, Pictures

TIMEOUT_MS = 60_000
NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")


def pack(value: Any) -> bytes:
    """Bytes of maps, lists, text and arrays."""
    return cast(bytes, msgpack.packb(value, default=_to_map))


def unpack(payload: bytes) -> Any:
    """Inverse of `pack`."""
    return msgpack.unpackb(payload, object_hook=_from_map)


def _to_map(array: NDArray[Any]) -> dict[str, Any]:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _from_map(value: dict[str, Any]) -> Any:
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    return value


def serve(port: int, takes_s: float) -> None:
    """Answer until the process ends; there, too, one request at a time."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
    socket.bind(f"tcp://{ADDRESS}:{port}")
    actions = {
        name: np.full((1, 1, 1), value, np.float32)
        for name, value in zip(NAMES, ACTION, strict=True)
    }
    while True:
        asked = unpack(socket.recv())
        assert asked["endpoint"] == "get_action"
        seen = asked["data"]["observation"]
        assert all(video.ndim == 5 for video in seen["video"].values())
        time.sleep(takes_s)
        socket.send(pack([actions, {}]))


class Client:
    """Client side."""

    def __init__(self, port: int) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, TIMEOUT_MS)
        self._socket.connect(f"tcp://{ADDRESS}:{port}")

    def request(self, pictures: Pictures) -> NDArray[Any]:
        """Send images; returns seven floats."""
        video = {f"image_{number}": rgb[None, None] for number, rgb in enumerate(pictures)}
        seen = {"video": video, "state": {}, "language": {"task": [[PROMPT]]}}
        data = {"observation": seen, "options": None}
        self._socket.send(pack({"endpoint": "get_action", "data": data}))
        actions, _ = unpack(self._socket.recv())
        return np.concatenate([actions[name][0, 0] for name in NAMES])

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
