"""Devices, streams and video files through OpenCV."""

from __future__ import annotations

import os
from collections.abc import Sequence

import cv2

from vla_zenoh.nodes.camera.source import STALL_S, Pixels

_SILENT = 0
# OpenCV reads these when it opens its first capture. A user's own values are kept.
_ENVIRONMENT = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg's "quiet"
    "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": f"{STALL_S:.0f}",
}


def prepare() -> None:
    """Silence OpenCV's logging and shorten its time-outs; call it before threads start."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(_SILENT)


class Capture:
    """A `cv2.VideoCapture` that can be opened again."""

    def __init__(self) -> None:
        self._capture: cv2.VideoCapture | None = None

    def open(self, target: str, api: int, options: Sequence[int] = ()) -> bool:
        """Open a device, URL or file; False on failure (OpenCV gives no reason)."""
        self.close()
        capture = cv2.VideoCapture(target, api, list(options))
        if not capture.isOpened():
            capture.release()
            return False
        self._capture = capture
        return True

    @property
    def backend(self) -> str:
        """OpenCV's name of its back end; empty while closed."""
        return "" if self._capture is None else self._capture.getBackendName()

    def get(self, quantity: int) -> float:
        """A capture property, 0 where unknown."""
        return 0.0 if self._capture is None else self._capture.get(quantity)

    def set(self, quantity: int, value: float) -> bool:
        """Set a capture property; False where the device has none."""
        return self._capture is not None and self._capture.set(quantity, value)

    def grab(self) -> bool:
        """Wait for the next image; False on failure."""
        return self._capture is not None and self._capture.grab()

    def retrieve(self) -> Pixels | None:
        """Decode the grabbed image; None if it is corrupt."""
        if self._capture is None:
            return None
        good, image = self._capture.retrieve()
        return image if good else None

    def close(self) -> None:
        """Release the capture."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
