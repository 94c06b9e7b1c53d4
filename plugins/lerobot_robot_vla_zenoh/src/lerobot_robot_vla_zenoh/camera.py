"""A camera on the bus as a camera of LeRobot."""

from __future__ import annotations

import os
import threading
import time
from contextlib import ExitStack
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray

import vla_zenoh
from lerobot_robot_vla_zenoh.config import VlaZenohCameraConfig
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.profile import load_profile

FIRST_IMAGE_S = 20.0
"""A camera that is just starting has an image within this."""
QUIET_S = 0.5
PERIODS = 3
"""`VlaZenohCamera.read` waits for a new image for this many periods."""

Pixels = NDArray[np.uint8]


class VlaZenohCamera(Camera):
    """The JPEG stream of a camera: RGB uint8 (height, width, 3)."""

    def __init__(self, config: VlaZenohCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._opened = ExitStack()
        self._thread: threading.Thread | None = None
        self._end, self._new = threading.Event(), threading.Condition()
        self._image: Pixels | None = None
        self._arrived_s = 0.0
        self._unread = False
        self._why = ""

    def __str__(self) -> str:
        return f"camera {self.config.camera} of {self.config.profile}"

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Those of the profile that ``VLA_ZENOH_PROFILE`` names, or of ``panda_sim``."""
        name = os.environ.get("VLA_ZENOH_PROFILE", "panda_sim")
        return [
            {
                "type": "vla_zenoh",
                "id": camera,
                "profile": name,
                "default_stream_profile": {
                    "width": each.width,
                    "height": each.height,
                    "fps": each.rate_hz,
                },
            }
            for camera, each in load_profile(name).cameras.items()
        ]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Join the bus and wait for the first image, also without `warmup`: its size is checked.

        Raises:
            DeviceNotConnectedError: no router, or no image.
            ValueError: the images have another size.
        """
        with ExitStack() as opened:
            try:
                remote = opened.enter_context(
                    vla_zenoh.connect(self.config.profile, endpoints=self.config.endpoints)
                )
                self._take(remote, FIRST_IMAGE_S)
            except VlaZenohError as error:
                raise DeviceNotConnectedError(f"{self}: {error}") from error
            self._end.clear()
            self._thread = threading.Thread(
                target=self._receive, args=(remote,), name=str(self), daemon=True
            )
            self._thread.start()
            self._opened = opened.pop_all()

    def _take(self, remote: vla_zenoh.RemoteRobot, timeout_s: float) -> None:
        rgb = remote.image(self.config.camera, jpeg=True, timeout_s=timeout_s).record.rgb
        height, width = rgb.shape[:2]
        if (width, height) != (self.width, self.height):
            raise ValueError(
                f"{self}: its images have {width}x{height} pixels, "
                f"not width={self.width}, height={self.height}"
            )
        with self._new:
            self._image, self._arrived_s, self._unread = np.array(rgb), time.monotonic(), True
            self._new.notify_all()

    def _receive(self, remote: vla_zenoh.RemoteRobot) -> None:
        while not self._end.is_set():
            try:
                self._take(remote, QUIET_S)
                self._why = ""
            except (VlaZenohError, ValueError) as error:
                self._why = str(error)

    @check_if_not_connected
    def read(self) -> Pixels:
        """The next image that arrives; otherwise as `async_read`."""
        with self._new:
            self._unread = False
        return self.async_read(1e3 * max(PERIODS / (self.fps or 1), QUIET_S))

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> Pixels:
        """The newest image that was not read yet, waiting for one.

        Raises:
            TimeoutError: none came within `timeout_ms`.
        """
        with self._new:
            if not self._new.wait_for(lambda: self._unread, timeout_ms / 1e3):
                raise TimeoutError(f"{self}: no image for {timeout_ms:g} ms. {self._why}".strip())
            self._unread = False
            assert self._image is not None
            return self._image

    @check_if_not_connected
    def read_latest(self, max_age_ms: int = 500) -> Pixels:
        """The newest image, read before or not.

        Raises:
            TimeoutError: it arrived longer ago than `max_age_ms`.
        """
        with self._new:
            assert self._image is not None
            age_ms = 1e3 * (time.monotonic() - self._arrived_s)
            if age_ms > max_age_ms:
                why = f"its newest image is {age_ms:.0f} ms old, at most {max_age_ms} are allowed"
                raise TimeoutError(f"{self}: {why}. {self._why}".strip())
            return self._image

    @check_if_not_connected
    def disconnect(self) -> None:
        """Leave the bus."""
        assert self._thread is not None
        self._end.set()
        self._thread.join()
        self._thread = None
        self._opened.close()
