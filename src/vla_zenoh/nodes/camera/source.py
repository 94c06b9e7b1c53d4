"""Sources of images that the camera node waits for, and how OpenCV reads them."""

from __future__ import annotations

import os
import re
import threading
from abc import ABC, abstractmethod

import cv2

from vla_zenoh.nodes.camera.geometry import Intrinsics, Pixels

LOOK_S = 0.5
"""Without subscribers one image in this time is still decoded, to detect a broken camera."""
STALL_S = 2.0
"""A source that delivers no image for this long is closed and opened again."""
_USER = re.compile(r"(?<=://)[^/]*@")
_SECRET = re.compile(r"(?i)(password|passwd|pass|pwd|token)=[^&/?]*")
_SILENT = 0
# OpenCV reads these when it opens its first capture. A user's own values are kept.
_ENVIRONMENT = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg's "quiet"
    "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": f"{STALL_S:.0f}",
}


class Source(ABC):
    """A device, stream or file. Used by one thread; may be opened again after `close`.

    Attributes:
        backend: name of the library or driver that reads it; known once it is open.
        same_s: how long a working source may repeat an identical image, s; 0: indefinitely.
        stamp_ns: driver's time stamp of the grabbed image, on any clock; None if there is none.
        intrinsics: of its images, if it knows them once it is open.
    """

    backend = ""
    same_s = 0.0
    stamp_ns: int | None = None
    intrinsics: Intrinsics | None = None

    @abstractmethod
    def open(self) -> None:
        """Open the source, or raise a `NodeError` that says what to do."""

    @abstractmethod
    def grab(self, stop: threading.Event) -> int | None:
        """Wait for the next image, decoding as little of it as possible.

        Returns its time of capture, ns of the monotonic clock; None if `stop` was set.
        `NodeError`: the source is gone. A source without a clock of its own waits here until the
        image is due, as `file.py` does.
        """

    @abstractmethod
    def retrieve(self) -> Pixels | None:
        """Decode the grabbed image; None if it is corrupt."""

    @abstractmethod
    def close(self) -> None:
        """Release the device; harmless if it is not open."""

    def depth_m(self) -> Pixels | None:
        """(H, W) depth of the grabbed image in m, in its pixels; 0: not measured. None: none."""
        return None


def prepare_opencv() -> None:
    """Silence OpenCV's logging and shorten its time-outs; call it before threads start."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(_SILENT)


def without_password(url: str) -> str:
    """`url` without its user, password and token parameters, for logs."""
    return _SECRET.sub(r"\1=***", _USER.sub("", url))
