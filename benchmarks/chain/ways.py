"""The measured ways from an image to seven floats, and ours further to a pose command."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Literal

from benchmarks.peers import Pictures
from benchmarks.picture import HEIGHT, WIDTH, noisy_picture

Kind = Literal["chain", "echo", "peer"]


@dataclass(frozen=True, slots=True)
class ServingWay:
    """One thing to measure.

    Args:
        name: on the command line and in JSON.
        kind: ``chain`` our nodes, ``echo`` Zenoh alone, ``peer`` another way of serving.
        title: for the table.
        modules: Python modules it needs from the extra ``bench``.
        command_hz: rate of the command node of a chain.
        routed: the echo goes through a router process.
    """

    name: str
    kind: Kind
    title: str
    modules: tuple[str, ...] = ()
    command_hz: float = 0.0
    routed: bool = False

    def missing(self) -> tuple[str, ...]:
        """Modules that are not installed."""
        return tuple(name for name in self.modules if importlib.util.find_spec(name) is None)


@dataclass(frozen=True, slots=True)
class Load:
    """Load of every way in a round.

    Args:
        requests: their number.
        size: width and height of an image.
        cameras: images in a request.
        pause: from one request to the next; without it each follows the answer to the last.
    """

    requests: int = 100
    size: tuple[int, int] = (WIDTH, HEIGHT)
    cameras: int = 1
    pause: bool = True

    def pictures(self, seed: int = 0) -> Pictures:
        """Images of a request."""
        return [noisy_picture(*self.size, seed)] * self.cameras


WAYS = (
    ServingWay("chain-250", "chain", "vla-zenoh, command node at 250 Hz", command_hz=250.0),
    ServingWay("chain-1000", "chain", "vla-zenoh, command node at 1000 Hz", command_hz=1000.0),
    ServingWay("zenoh-router", "echo", "Zenoh alone, through the router", routed=True),
    ServingWay("zenoh-direct", "echo", "Zenoh alone, direct"),
    ServingWay("flask", "peer", "Flask and requests, PNG as base64 in JSON", ("flask", "requests")),
    ServingWay("openpi", "peer", "openpi's WebSocket, msgpack-numpy", ("websockets",)),
    ServingWay("zmq", "peer", "ZeroMQ REQ/REP, msgpack", ("zmq",)),
)
REFERENCE = "chain-250"
"""The way whose round trip to a chunk the others are compared with."""
