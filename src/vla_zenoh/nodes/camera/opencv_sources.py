"""Sources that OpenCV reads: cameras of this computer by Video4Linux, network cameras by RTSP over
TCP, and files that are replayed as a live camera."""

from __future__ import annotations

import math
import os
import re
import threading
import time
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.geometry import Pixels
from vla_zenoh.nodes.camera.source import STALL_S, Source, without_password
from vla_zenoh.nodes.camera.v4l2_devices import DEV, SYS, find_device
from vla_zenoh.opencv import cv2
from vla_zenoh.profile.schema import CameraProfile


class CaptureSource(Source):
    """A `Source` that OpenCV's `VideoCapture` reads."""

    def __init__(self) -> None:
        self._capture = cv2.VideoCapture()

    def retrieve(self) -> Pixels | None:
        good, image = self._capture.retrieve()
        return image if good else None

    def close(self) -> None:
        self._capture.release()


# -- network cameras ------------------------------------------------------------------------------
OPEN_S = 10.0
"""To log in and to wait for a key frame, which some cameras send every few seconds only."""
INSTANT_S = 0.015
MAX_BACKLOG = 500
RTSP_SAME_S = 5.0
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

    same_s = RTSP_SAME_S

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


# -- devices --------------------------------------------------------------------------------------
MAX_UNCOMPRESSED_PX = 640 * 480
"""USB 2 carries at most this many uncompressed pixels at 30 Hz."""
SANE_AGE_S = 1.0
SAME_S = 1.0
"""Sensor noise makes any two images differ in some bit of thousands of pixels."""
MANUAL_EXPOSURE = 1
"""V4L2_EXPOSURE_MANUAL."""
EXPOSURE_UNIT_US = 100.0
"""Of V4L2_CID_EXPOSURE_ABSOLUTE."""
VIRTUAL = "/sys/devices/virtual/"


class V4l2Source(CaptureSource):
    """A device such as ``/dev/video0`` or ``/dev/v4l/by-id/...``, or one with a serial number.

    Args:
        device: see `find_device`.
        profile: size, rate and locks to request; the device may choose another size and rate.
    """

    same_s = SAME_S

    def __init__(self, device: str, profile: CameraProfile) -> None:
        super().__init__()
        self._device, self._path, self._profile = device, DEV, profile

    def open(self) -> None:
        # At every opening: a camera that was plugged in again may have another number.
        self._path = find_device(self._device)
        why = why_not(self._path)
        if why:
            raise NodeError(why)
        self.same_s = 0.0 if is_virtual(self._path) else SAME_S
        width, height = self._profile.width, self._profile.height
        options = [
            *(cv2.CAP_PROP_FRAME_WIDTH, width),
            *(cv2.CAP_PROP_FRAME_HEIGHT, height),
            *(cv2.CAP_PROP_FPS, max(1, round(self._profile.rate_hz))),
        ]
        if width * height > MAX_UNCOMPRESSED_PX:
            options = [cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"), *options]
        # A device that does not support these settings may still open without them.
        if not any(
            self._capture.open(str(self._path), cv2.CAP_V4L2, asked) for asked in (options, [])
        ):
            raise NodeError(
                f"{self._path} exists but cannot be opened as a camera: does another program use "
                f"it (fuser -v {self._path})? Of a camera with several devices, only the first one "
                "gives images"
            )
        self.backend = self._capture.getBackendName()
        self._lock()

    def _lock(self) -> None:
        """Fix what the profile fixes; the rest stays as it was set on the device."""
        exposure_us, white_k = self._profile.exposure_us, self._profile.white_balance_k
        if exposure_us is not None:
            exposure = exposure_us / EXPOSURE_UNIT_US
            self._fix("exposure_us", cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
            self._fix("exposure_us", cv2.CAP_PROP_EXPOSURE, exposure)
        if white_k is not None:
            self._fix("white_balance_k", cv2.CAP_PROP_AUTO_WB, 0)
            self._fix("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, white_k)

    def _fix(self, name: str, quantity: int, value: float) -> None:
        if not self._capture.set(quantity, value):
            raise NodeError(f"{self._path} does not take {name}: leave it out of the profile")

    def grab(self, stop: threading.Event) -> int | None:
        if not self._capture.grab():
            raise NodeError(f"{self._path} gave no image for {STALL_S:g} s, or was unplugged")
        position_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
        self.stamp_ns = round(position_ms * 1e6) if position_ms > 0 else None
        return captured_ns(position_ms, time.monotonic_ns())


def captured_ns(position_ms: float, now_ns: int) -> int:
    """Time of capture: the kernel's stamp if it is on the monotonic clock, else `now_ns`, right
    after the image was grabbed. Some drivers give 0 or wall time."""
    stamp_ns = round(position_ms * 1e6)
    return stamp_ns if 0 <= now_ns - stamp_ns < SANE_AGE_S * 1e9 else now_ns


def is_virtual(path: Path, sys: Path = SYS) -> bool:
    """Whether `path` is a software device such as v4l2loopback, whose images may have no noise."""
    return (sys / path.resolve().name).resolve().is_relative_to(VIRTUAL)


def why_not(path: Path) -> str:
    """Why this user cannot open `path`, and what to do; empty if nothing prevents it."""
    if not path.exists():
        there = ", ".join(map(str, sorted(DEV.glob("video[0-9]*")))) or "none"
        return (
            f"there is no {path}; cameras here: {there}. Plug it in, or correct its source in the "
            f"profile; in a container: --device={path}"
        )
    if not os.access(path, os.R_OK | os.W_OK):
        return (
            f"no permission for {path}: sudo usermod --append --groups video $USER, then log in "
            "again"
        )
    return ""


# -- files ----------------------------------------------------------------------------------------
FILE_LOOK_S = 0.5
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
            self._look_s = now + FILE_LOOK_S
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
