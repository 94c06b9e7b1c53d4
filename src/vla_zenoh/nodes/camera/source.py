"""Sources of images that the camera node waits for, and the thread that reads one."""

from __future__ import annotations

import os
import re
import threading
import time
from abc import ABC, abstractmethod

from vla_zenoh.errors import NodeError, in_words
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.nodes.camera.geometry import Intrinsics, Pixels
from vla_zenoh.opencv import cv2

LOOK_S = 0.5
"""Without subscribers one image in this time is still decoded, to detect a broken camera."""
STALL_S = 2.0
"""A source that delivers no image for this long is closed and opened again."""
BACKOFF_S, MAX_BACKOFF_S = 0.2, 2.0
BROKEN_IN_A_ROW = 5
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

    A constructor that raises ends the whole node: `CameraProfile` checks what is written, `open`
    what is there.

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
        image is due, as a file does.
        """

    @abstractmethod
    def retrieve(self) -> Pixels | None:
        """Decode the grabbed image, see `Pixels`: BGR where it has colour; None if corrupt."""

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


class Grabber:
    """Reads one source and reopens it after every failure; `run` is the body of a thread."""

    def __init__(self, source: Source, publisher: CameraPublisher) -> None:
        self._source, self._publisher = source, publisher
        self._backoff_s = BACKOFF_S

    def run(self, stop: threading.Event) -> None:
        """Grab images until `stop` is set."""
        while not stop.is_set():
            try:
                self._source.open()
                self._publisher.opened(
                    self._source.backend, self._source.same_s, self._source.intrinsics
                )
                self._grab_all(stop)
            except Exception as error:  # whatever a driver raises must not end the other cameras
                if stop.is_set():
                    return
                self._publisher.lose(in_words(error))
            finally:
                self._source.close()
            stop.wait(self._backoff_s)
            self._backoff_s = min(2 * self._backoff_s, MAX_BACKOFF_S)

    def _grab_all(self, stop: threading.Event) -> None:
        source, publisher = self._source, self._publisher
        opened = last_good = looked = time.monotonic()
        proved, broken = False, 0
        while (mono_ns := source.grab(stop)) is not None and not stop.is_set():
            now = time.monotonic()
            if proved:
                publisher.captured(mono_ns)
            # The current time, not that of capture: a backlog must not come out in a burst.
            if not publisher.due(time.monotonic_ns()):
                continue
            wanted = publisher.has_subscribers or not proved
            if not wanted and now - looked < LOOK_S:
                last_good = now
                continue
            image = source.retrieve()
            if image is None:
                publisher.count_broken()
                broken += 1
                if broken >= BROKEN_IN_A_ROW and now - last_good > STALL_S:
                    raise NodeError(f"the last {broken} images could not be decoded")
                continue
            looked = now
            publisher.check(image, mono_ns, source.stamp_ns)
            if wanted:
                depth_m = source.depth_m() if publisher.wants_depth else None
                publisher.publish(image, mono_ns, depth_m)
            publisher.captured(mono_ns)
            last_good, proved, broken = now, True, 0
            publisher.set_state(OK)
            if now - opened > STALL_S:
                self._backoff_s = BACKOFF_S
