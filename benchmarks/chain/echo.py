"""Zenoh alone: a picture there and seven floats back, with none of our records around them."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from benchmarks.peers import ACTION
from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.session import QOS, open_session
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Kind
from vla_zenoh.profile import SessionProfile
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S

PICTURE_KEY, ANSWER_KEY = "vla-zenoh-bench/picture", "vla-zenoh-bench/answer"
TIMEOUT_S = 1.0
POLL_S = 0.25


def session_at(endpoint: str, *, listen: bool) -> zenoh.Session:
    """A client of a router at `endpoint`, or the one that others connect to there."""
    if listen:
        return open_session(SessionProfile(listen=(endpoint,)), mode="router")
    return open_session(SessionProfile(connect=(endpoint,)), wait_s=ROUTER_PATIENCE_S)


def serve(endpoint: str, *, listen: bool, stop: threading.Event) -> None:
    """Answer every picture until `stop` is set."""
    answer = np.array(ACTION, np.float32).tobytes()
    pictures = LatestSample()
    with session_at(endpoint, listen=listen) as session:
        out = session.declare_publisher(ANSWER_KEY, **QOS[Kind.ORDER])
        handler = zenoh.handlers.Callback(pictures, indirect=False)
        subscriber = session.declare_subscriber(PICTURE_KEY, handler)
        while not stop.is_set():
            if not pictures.wait(POLL_S):
                continue
            arrival = pictures.pop()
            if arrival is not None:
                np.frombuffer(arrival.sample.payload.to_bytes(), np.uint8)
                out.put(answer)
        subscriber.undeclare()


class EchoClient:
    """The asking end.

    Args:
        endpoint: where the server or the router listens.
    """

    def __init__(self, endpoint: str) -> None:
        self._session = session_at(endpoint, listen=False)
        self._answers = LatestSample()
        handler = zenoh.handlers.Callback(self._answers, indirect=False)
        self._subscriber = self._session.declare_subscriber(ANSWER_KEY, handler)
        self._out = self._session.declare_publisher(PICTURE_KEY, **QOS[Kind.FRAME])

    def await_server(self, timeout_s: float) -> None:
        """Wait until pictures are listened to.

        Raises:
            NodeError: nobody does.
        """
        give_up = time.monotonic() + timeout_s
        while not self._out.matching_status.matching:  # pyright: ignore  # stub says bool
            if time.monotonic() > give_up:
                raise NodeError("the echo of the benchmark does not answer")
            time.sleep(0.01)

    def request(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """A picture there, seven floats back.

        Raises:
            TimeoutError: none came.
        """
        self._answers.pop()
        self._out.put(rgb.tobytes())
        if not self._answers.wait(TIMEOUT_S):
            raise TimeoutError
        arrival = self._answers.pop()
        assert arrival is not None
        return np.frombuffer(arrival.sample.payload.to_bytes(), np.float32)

    def close(self) -> None:
        """Close the session."""
        self._subscriber.undeclare()
        self._session.close()
