"""ZeroMQ REQ/REP over TCP, arrays in msgpack: as GR00T's server, it has one request at a time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.peers import ACTION, ADDRESS, PROMPT, Pictures, arrays

TIMEOUT_MS = 10_000


def serve(port: int, takes_s: float) -> None:
    """Answer until the process ends."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
    socket.bind(f"tcp://{ADDRESS}:{port}")
    actions = np.array([ACTION], np.float32)
    while True:
        asked = arrays.unpack(socket.recv())
        assert all(image.ndim == 3 for image in asked["images"])
        time.sleep(takes_s)
        socket.send(arrays.pack({"actions": actions}))


class Client:
    """Client side."""

    def __init__(self, port: int) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, TIMEOUT_MS)
        self._socket.connect(f"tcp://{ADDRESS}:{port}")

    def request(self, pictures: Pictures) -> NDArray[Any]:
        """Send images; returns seven floats."""
        self._socket.send(arrays.pack({"images": list(pictures), "prompt": PROMPT}))
        return arrays.unpack(self._socket.recv())["actions"][0]

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
