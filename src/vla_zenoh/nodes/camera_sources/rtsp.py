"""Network cameras, through RTSP over TCP."""

from __future__ import annotations

import re
import threading
import time

import cv2

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera_sources.opencv import Capture
from vla_zenoh.nodes.camera_sources.source import STALL_S, Pixels

_PASSWORD = re.compile(r"(?<=://)[^/]*@")
_STALL_MS = round(STALL_S * 1000)
_OPTIONS = (
    *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _STALL_MS),
    *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, _STALL_MS),
    # Each further decoding thread keeps one more picture back.
    *(cv2.CAP_PROP_N_THREADS, 1),
)


def without_password(url: str) -> str:
    """`url` without user and password, fit for logs."""
    return _PASSWORD.sub("", url)


class RtspSource:
    """A stream that is stamped when it arrives: its own clock is not ours.

    Args:
        url: ``rtsp://[user:password@]host[:port]/path``.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._capture = Capture()

    @property
    def backend(self) -> str:
        return self._capture.backend

    def open(self) -> None:
        if not self._capture.open(self._url, cv2.CAP_FFMPEG, _OPTIONS):
            raise NodeError(
                f"{without_password(self._url)} does not answer with a picture within "
                f"{STALL_S:g} s; is the camera on, and are address, user and password right?"
            )

    def grab(self, stop: threading.Event) -> int | None:
        if not self._capture.grab():
            raise NodeError(
                f"{without_password(self._url)} has ended, or sent nothing for {STALL_S:g} s"
            )
        return time.monotonic_ns()

    def retrieve(self) -> Pixels | None:
        return self._capture.retrieve()

    def close(self) -> None:
        self._capture.close()
