"""Zenoh alone: images there and seven floats back, without our records."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from benchmarks.peers import ACTION, Pictures
from vla_zenoh.bus.buffers import LatestSample, Wake
from vla_zenoh.bus.session import QOS, open_session
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Kind
from vla_zenoh.profile import SessionProfile
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S

PICTURE_KEYS = tuple(f"vla-zenoh-bench/picture/{camera}" for camera in range(3))
ANSWER_KEY = "vla-zenoh-bench/answer"
TIMEOUT_S = 1.0
POLL_S = 0.25


def session_at(endpoint: str, *, listen: bool) -> zenoh.Session:
    """A client of a router at `endpoint`, or the peer that listens there."""
    if listen:
        return open_session(SessionProfile(listen=(endpoint,)), mode="router")
    return open_session(SessionProfile(connect=(endpoint,)), wait_s=ROUTER_PATIENCE_S)


def serve(endpoint: str, cameras: int, *, listen: bool, stop: threading.Event) -> None:
    """Answer every `cameras` images until `stop` is set."""
    answer = np.array(ACTION, np.float32).tobytes()
    changed = Wake()
    slots = [LatestSample(changed=changed) for _ in range(cameras)]
    with session_at(endpoint, listen=listen) as session:
        out = session.declare_publisher(ANSWER_KEY, **QOS[Kind.ORDER])
        subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(slot, indirect=False))
            for key, slot in zip(PICTURE_KEYS, slots, strict=False)
        ]
        while not stop.is_set():
            if not changed.wait(POLL_S) or not all(slot.has_new for slot in slots):
                continue
            for arrival in [slot.pop() for slot in slots]:
                assert arrival is not None
                np.frombuffer(arrival.sample.payload.to_bytes(), np.uint8)
            out.put(answer)
        for subscriber in subscribers:
            subscriber.undeclare()


class EchoClient:
    """Client side.

    Args:
        endpoint: where the server or the router listens.
        cameras: images in a request.
    """

    def __init__(self, endpoint: str, cameras: int) -> None:
        self._session = session_at(endpoint, listen=False)
        self._answers = LatestSample()
        handler = zenoh.handlers.Callback(self._answers, indirect=False)
        self._subscriber = self._session.declare_subscriber(ANSWER_KEY, handler)
        self._outs = [
            self._session.declare_publisher(key, **QOS[Kind.FRAME])
            for key in PICTURE_KEYS[:cameras]
        ]

    def await_server(self, timeout_s: float) -> None:
        """Wait until the server subscribes to images.

        Raises:
            NodeError: it does not.
        """
        give_up = time.monotonic() + timeout_s
        while not all(out.matching_status.matching for out in self._outs):  # pyright: ignore
            if time.monotonic() > give_up:
                raise NodeError("the echo of the benchmark does not answer")
            time.sleep(0.01)

    def request(self, pictures: Pictures) -> NDArray[Any]:
        """Send images; returns seven floats.

        Raises:
            TimeoutError: none arrived.
        """
        self._answers.pop()
        for out, rgb in zip(self._outs, pictures, strict=True):
            out.put(rgb.tobytes())
        if not self._answers.wait(TIMEOUT_S):
            raise TimeoutError
        arrival = self._answers.pop()
        assert arrival is not None
        return np.frombuffer(arrival.sample.payload.to_bytes(), np.float32)

    def close(self) -> None:
        """Close the session."""
        self._subscriber.undeclare()
        self._session.close()
