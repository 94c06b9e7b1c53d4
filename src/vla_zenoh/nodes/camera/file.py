"""A video file, a folder of images, or a single image, replayed as a live camera."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.geometry import Pixels
from vla_zenoh.nodes.camera.source import Source

LOOK_S = 0.5
"""An open file stays readable after it was deleted, so its name is checked this often."""
MAX_VIDEO_HZ = 1000.0


class Frames(NamedTuple):
    """The images of a file or folder, once, in order; `rate_hz` of a video.

    Each of `images` decodes one, None where it is corrupt. Closing them closes the file.
    """

    images: Generator[Callable[[], Pixels | None]]
    backend: str = "pictures"
    rate_hz: float | None = None


def open_video(path: Path) -> Frames:
    """The images of a video; `NodeError`: it cannot be read."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise NodeError(f"{path} is neither an image nor a video that can be read")

    def decode() -> Pixels | None:
        good, image = capture.retrieve()
        return image if good else None

    def images() -> Generator[Callable[[], Pixels | None]]:
        try:
            while capture.grab():
                yield decode
        finally:
            capture.release()

    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    sane = math.isfinite(rate_hz) and 0 < rate_hz <= MAX_VIDEO_HZ
    return Frames(images(), capture.getBackendName(), rate_hz if sane else None)


def natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts ``2.png`` before ``10.png``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts]


def open_frames(path: Path) -> Frames:
    """The images of the video, folder or image at `path`; `NodeError`: there are none."""
    if not path.exists():
        raise NodeError(f"there is no file or folder {path}; waiting until it exists")
    if path.is_file() and not cv2.haveImageReader(str(path)):
        return open_video(path)
    files = sorted(path.iterdir(), key=natural) if path.is_dir() else [path]
    images = [str(file) for file in files if file.is_file() and cv2.haveImageReader(str(file))]
    if not images:
        raise NodeError(f"there is no image in the folder {path}")
    return Frames(partial(cv2.imread, image, cv2.IMREAD_COLOR) for image in images)


class FileSource(Source):
    """Replays in real time, again and again, a video at its own rate, or an image or a folder of
    images (in natural order of their names) at `rate_hz`."""

    def __init__(self, path: str, rate_hz: float) -> None:
        self._path, self._rate_hz = Path(path).expanduser(), rate_hz
        self._frames: Frames | None = None
        self._image: Callable[[], Pixels | None] | None = None
        self._identity: tuple[int, int] = (0, 0)
        self._next_s = self._look_s = 0.0
        self._period_s = 1.0 / rate_hz

    def open(self) -> None:
        self.close()
        self._frames = open_frames(self._path)
        self.backend = self._frames.backend
        self._identity = self._file_identity()
        self._period_s = 1.0 / (self._frames.rate_hz or self._rate_hz)
        self._next_s = time.monotonic()

    def grab(self, stop: threading.Event) -> int | None:
        if stop.wait(max(0.0, self._next_s - time.monotonic())):
            return None
        now = time.monotonic()
        # After a stall the schedule restarts from now: missed images do not follow in a burst.
        late = now - self._next_s > self._period_s
        self._next_s = (now if late else self._next_s) + self._period_s
        if now >= self._look_s:
            self._look_s = now + LOOK_S
            if self._file_identity() != self._identity:
                raise NodeError(f"{self._path} was replaced by another file")
        self._image = None if self._frames is None else next(self._frames.images, None)
        if self._image is None:  # again from the start
            self.close()
            self._frames = open_frames(self._path)
            self._image = next(self._frames.images, None)
            if self._image is None:
                raise NodeError(f"there is no image in {self._path}")
        return time.monotonic_ns()

    def retrieve(self) -> Pixels | None:
        return None if self._image is None else self._image()

    def close(self) -> None:
        if self._frames is not None:
            self._frames.images.close()
            self._frames = self._image = None

    def _file_identity(self) -> tuple[int, int]:
        try:
            found = self._path.stat()
        except OSError as error:
            raise NodeError(f"{self._path} has vanished: {error.strerror}") from error
        return found.st_dev, found.st_ino
