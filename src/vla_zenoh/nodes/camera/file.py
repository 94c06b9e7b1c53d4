"""A video file, a folder of pictures, or a single picture, shown as if a camera saw it now."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import cv2

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.opencv import Capture
from vla_zenoh.nodes.camera.source import Pixels

LOOK_S = 0.5
"""An open file can be read on after it was removed, so its name is looked up this often."""
MAX_VIDEO_HZ = 1000.0


class FrameReader(Protocol):
    """Pictures in order, once."""

    backend: str
    rate_hz: float | None

    def step(self) -> bool:
        """Go to the next picture; False at the end."""
        ...

    def picture(self) -> Pixels | None:
        """The picture stepped to, None when it is broken."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...


class VideoFile:
    """A video file, with the rate it says it has.

    Raises:
        NodeError: not a video that can be read.
    """

    def __init__(self, path: Path) -> None:
        self._capture = Capture()
        if not self._capture.open(str(path), cv2.CAP_FFMPEG):
            raise NodeError(f"{path} is neither a picture nor a video that can be read")
        self.backend = self._capture.backend
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        sane = math.isfinite(rate_hz) and 0 < rate_hz <= MAX_VIDEO_HZ
        self.rate_hz: float | None = rate_hz if sane else None

    def step(self) -> bool:
        return self._capture.grab()

    def picture(self) -> Pixels | None:
        return self._capture.retrieve()

    def close(self) -> None:
        self._capture.close()


class ImageFolder:
    """Picture files; they are read only when one is asked for."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._rest = iter(paths)
        self._path: Path | None = None
        self.backend = "pictures"
        self.rate_hz: float | None = None

    def step(self) -> bool:
        self._path = next(self._rest, None)
        return self._path is not None

    def picture(self) -> Pixels | None:
        return cv2.imread(str(self._path), cv2.IMREAD_COLOR)

    def close(self) -> None:
        self._rest = iter(())


def natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts ``2.png`` before ``10.png``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts]


def open_frames(path: Path) -> FrameReader:
    """What lies at `path`.

    Raises:
        NodeError: nothing that can be shown.
    """
    if path.is_dir():
        pictures = [
            file
            for file in sorted(path.iterdir(), key=natural)
            if file.is_file() and cv2.haveImageReader(str(file))
        ]
        if not pictures:
            raise NodeError(f"there is no picture in the folder {path}")
        return ImageFolder(pictures)
    if not path.exists():
        raise NodeError(f"there is no file or folder {path}; it is looked for until it is there")
    return ImageFolder([path]) if cv2.haveImageReader(str(path)) else VideoFile(path)


class FileSource:
    """Shows a file in its own time: a video at its rate, pictures at `rate_hz`.

    Args:
        path: video, folder of pictures (in natural order of their names), or picture.
        rate_hz: of pictures, and of a video that does not know its rate.
        loop: start again at the end.
    """

    same_s, stamp_ns = 0.0, None  # a picture may be shown for as long as one likes

    def __init__(self, path: str, rate_hz: float, loop: bool) -> None:
        self._path = Path(path).expanduser()
        self._rate_hz, self._loop = rate_hz, loop
        self._reel: FrameReader | None = None
        self._identity: tuple[int, int] = (0, 0)
        self._next_s = self._look_s = 0.0
        self._period_s = 1.0 / rate_hz

    @property
    def backend(self) -> str:
        return "" if self._reel is None else self._reel.backend

    def open(self) -> None:
        self.close()
        self._reel = open_frames(self._path)
        self._identity = self._who()
        self._period_s = 1.0 / (self._reel.rate_hz or self._rate_hz)
        self._next_s = time.monotonic()

    def grab(self, stop: threading.Event) -> int | None:
        if stop.wait(max(0.0, self._next_s - time.monotonic())):
            return None
        now = time.monotonic()
        # After a stall it goes on from here: what was missed is not shown in a hurry.
        late = now - self._next_s > self._period_s
        self._next_s = (now if late else self._next_s) + self._period_s
        if now >= self._look_s:
            self._look_s = now + LOOK_S
            if self._who() != self._identity:
                raise NodeError(f"{self._path} was replaced by another file")
        return time.monotonic_ns() if self._step() else None

    def retrieve(self) -> Pixels | None:
        return None if self._reel is None else self._reel.picture()

    def close(self) -> None:
        if self._reel is not None:
            self._reel.close()
            self._reel = None

    def _step(self) -> bool:
        if self._reel is not None and self._reel.step():
            return True
        if not self._loop:
            return False
        self.close()
        self._reel = open_frames(self._path)
        if not self._reel.step():
            raise NodeError(f"there is no picture in {self._path}")
        return True

    def _who(self) -> tuple[int, int]:
        try:
            found = self._path.stat()
        except OSError as error:
            raise NodeError(f"{self._path} has vanished: {error.strerror}") from error
        return found.st_dev, found.st_ino
