"""Other ways of serving a policy, each as it is commonly done: a server and its client.

A module here has ``serve(port, takes_s)``, which ends with its process, and ``Client(port)`` with
``request(pictures)``, which returns the seven floats. An inference takes `takes_s`; there is one at
a time, as on one GPU.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

MODULES = {
    "flask": "flask_json",
    "openpi": "openpi_websocket",
    "zmq": "zmq_msgpack",
    "groot": "groot_zmq",
    "lerobot": "lerobot_grpc",
}
ADDRESS = "127.0.0.1"
ACTION = (0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04)
"""What every server answers."""
PROMPT = "put the red brick in the box"


Pictures = Sequence[NDArray[np.uint8]]
"""(H, W, 3) of each camera, captured together."""


class PeerClient(Protocol):
    """Client side of a server."""

    def request(self, pictures: Pictures) -> NDArray[Any] | None:
        """Send images; returns seven floats, or None where they are of another robot's images."""
        ...

    def close(self) -> None: ...


class Peer(Protocol):
    """A module of this package."""

    def serve(self, port: int, takes_s: float) -> None: ...

    def Client(self, port: int) -> PeerClient: ...


def load(name: str) -> Peer:
    """The module of a way; its libraries are imported here and not before."""
    return cast(Peer, importlib.import_module(f"{__name__}.{MODULES[name]}"))
