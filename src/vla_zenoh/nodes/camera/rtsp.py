"""Network cameras: RTSP over TCP."""

from __future__ import annotations

import threading
import time

import cv2

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.source import STALL_S, CaptureSource, without_password

OPEN_S = 10.0
"""To log in and to wait for a key frame, which some cameras send every few seconds only."""
INSTANT_S = 0.015
MAX_BACKLOG = 500
SAME_S = 5.0
"""Compression may repeat a still scene until the next key frame, which rarely takes longer."""
_OPTIONS = (
    *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(OPEN_S * 1000)),
    *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(STALL_S * 1000)),
    # Each additional decoding thread delays the stream by one image.
    *(cv2.CAP_PROP_N_THREADS, 1),
)


class RtspSource(CaptureSource):
    """An RTSP stream. Images are stamped on arrival: the camera's clock is not ours.

    Args:
        url: ``rtsp://[user:password@]host[:port]/path``.
    """

    same_s = SAME_S

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url, self._shown = url, without_password(url)

    def open(self) -> None:
        if not self._capture.open(self._url, cv2.CAP_FFMPEG, _OPTIONS):
            raise NodeError(
                f"{self._shown} does not answer with an image within {OPEN_S:g} s; is the camera "
                "on, and are address, user and password right?"
            )
        self.backend = self._capture.getBackendName()
        # Images that queued up while OpenCV probed the stream return at once.
        for _ in range(MAX_BACKLOG):
            began = time.monotonic()
            if not self._capture.grab() or time.monotonic() - began > INSTANT_S:
                return

    def grab(self, stop: threading.Event) -> int | None:
        began = time.monotonic()
        good = self._capture.grab()
        # After its time-out OpenCV first returns what was left in the decoder: those are old.
        if not good or time.monotonic() - began > 0.9 * STALL_S:
            raise NodeError(f"{self._shown} has ended, or sent nothing for {STALL_S:g} s")
        return time.monotonic_ns()
