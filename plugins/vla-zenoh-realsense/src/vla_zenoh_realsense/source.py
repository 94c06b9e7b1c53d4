"""Intel RealSense cameras by their serial number: colour, and depth in the same view.

Through ``pyrealsense2`` (extra ``sdk``). Depth is aligned to colour, so both have the
intrinsics of colour and the same pixels.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import cv2
import numpy as np

from vla_zenoh.errors import MissingExtraError, NodeError, in_words
from vla_zenoh.nodes.camera.geometry import Intrinsics, Pixels
from vla_zenoh.nodes.camera.source import STALL_S, Source
from vla_zenoh.profile.schema import CameraProfile

WAIT_MS = 200
QUEUE = 4
SAME_S = 1.0
LOCK_TOLERANCE = 0.1
EXPOSURE_UNIT_US = 100.0
"""Of the colour sensor's exposure."""
WINDOW_S = 20.0
"""A clock that is off by 100 ppm moves by 2 ms in this time."""
SET_S = 0.5
"""A stamp that jumps further against its arrival means that the camera's clock was set."""


def sdk() -> Any:
    """The module ``pyrealsense2``; `MissingExtraError`: it is not installed."""
    try:
        return import_module("pyrealsense2")
    except ImportError as error:
        raise MissingExtraError(
            f"pyrealsense2 ({error})", "sdk", package="vla-zenoh-realsense"
        ) from error


def connected(context: Any = None) -> list[Any]:
    """Every RealSense camera of this computer."""
    return list((context or sdk().context()).query_devices())


def find_device(serial: str) -> Any:
    """The camera with this serial number; `NodeError`: it is not connected."""
    rs = sdk()
    serials = {one.get_info(rs.camera_info.serial_number): one for one in connected()}
    if serial not in serials:
        raise NodeError(
            f"there is no RealSense camera with the serial number {serial!r}; connected: "
            f"{', '.join(serials) or 'none'}"
        )
    return serials[serial]


class DeviceClock:
    """Offset of a camera's clock: the shortest time from stamp to arrival in the last `WINDOW_S`.

    Extra time over that of the fastest image is delay of the bus or this computer, not part of the
    capture time. The delay of the fastest one is unknown and counts as zero.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = deque()  # arrival, arrival - stamp; both ascending

    def host_ns(self, device_ns: int, arrival_ns: int) -> int:
        """Time of capture on the clock of `arrival_ns`, never later than that."""
        offset_ns = arrival_ns - device_ns
        offsets = self._offsets
        if offsets and abs(offset_ns - offsets[0][1]) > SET_S * 1e9:
            offsets.clear()
        while offsets and offsets[-1][1] >= offset_ns:
            offsets.pop()
        offsets.append((arrival_ns, offset_ns))
        while arrival_ns - offsets[0][0] > WINDOW_S * 1e9:
            offsets.popleft()
        return device_ns + offsets[0][1]


class RealsenseSource(Source):
    """A RealSense camera by its serial number, in the size nearest to the profile's."""

    same_s = SAME_S

    def __init__(
        self, serial: str, profile: CameraProfile, device_of: Callable[[str], Any] = find_device
    ) -> None:
        self._serial, self._profile, self._device_of = serial, profile, device_of
        self._sensors: list[Any] = []
        self._queue: Any = None
        self._align: Any = None
        self._colour: Any = None
        self._depth: Any = None
        self._clock = DeviceClock()

    def open(self) -> None:
        rs = sdk()
        device = self._device_of(self._serial)
        self._clock, self._queue = DeviceClock(), rs.frame_queue(QUEUE)
        self._align = rs.align(rs.stream.color)
        colours: tuple[Any, ...] = (rs.format.bgr8, rs.format.rgb8)
        wanted = [(rs.stream.color, colours)]
        if self._profile.depth_unit_m is not None:
            wanted.append((rs.stream.depth, (rs.format.z16,)))
        try:
            for sensor in device.query_sensors():
                chosen = [one for kind in wanted if (one := self._choose(sensor, *kind))]
                if not chosen:
                    continue
                if any(one.stream_type() == rs.stream.color for one in chosen):
                    self._lock(sensor)
                    self._set_intrinsics(chosen[0])
                sensor.open(chosen)
                self._sensors.append(sensor)
                sensor.start(self._queue)
                wanted = [
                    kind for kind in wanted if all(one.stream_type() != kind[0] for one in chosen)
                ]
        except RuntimeError as error:
            raise NodeError(
                f"RealSense camera {self._serial} cannot be opened: {in_words(error)}; does "
                "another program use it?"
            ) from error
        if wanted:
            kinds = " and ".join(str(kind).rsplit(".", 1)[-1] for kind, _ in wanted)
            raise NodeError(f"RealSense camera {self._serial} gives no {kinds}")
        self.backend = f"librealsense {getattr(rs, '__version__', '')}".strip()

    def grab(self, stop: threading.Event) -> int | None:
        give_up = time.monotonic() + STALL_S
        while not stop.is_set():
            good, frame = self._queue.try_wait_for_frame(WAIT_MS)
            arrival_ns = time.monotonic_ns()
            if good and self._complete(frame):
                return self._captured_ns(arrival_ns)
            if time.monotonic() > give_up:
                raise NodeError(
                    f"RealSense camera {self._serial} gave no image for {STALL_S:g} s, or was "
                    "unplugged"
                )
        return None

    def retrieve(self) -> Pixels | None:
        rgb = self._colour.get_profile().format() == sdk().format.rgb8
        image = np.asanyarray(self._colour.get_data())
        return cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if rgb else image.copy()

    def depth_m(self) -> Pixels | None:
        if self._depth is None or self._colour is None:
            return None
        depth = self._align.process(_frameset(self._depth, self._colour)).get_depth_frame()
        return np.asanyarray(depth.get_data()) * np.float32(depth.get_units())

    def close(self) -> None:
        self._colour = self._depth = None
        for sensor in self._sensors:
            for end in (sensor.stop, sensor.close):
                try:
                    end()
                except RuntimeError:  # it was unplugged
                    continue
        self._sensors.clear()

    def _choose(self, sensor: Any, kind: Any, formats: Sequence[Any]) -> Any:
        """The sensor's stream whose size, then rate, then format is nearest to the profile's."""
        wanted = self._profile
        found = [
            one.as_video_stream_profile()
            for one in sensor.get_stream_profiles()
            if one.stream_type() == kind and one.format() in formats
        ]
        return min(
            found,
            default=None,
            key=lambda one: (
                abs(one.width() - wanted.width) + abs(one.height() - wanted.height),
                one.fps() < wanted.rate_hz,
                abs(one.fps() - wanted.rate_hz),
                formats.index(one.format()),
            ),
        )

    def _set_intrinsics(self, profile: Any) -> None:
        found = profile.as_video_stream_profile().get_intrinsics()
        # The origin of librealsense is the centre of the first pixel.
        self.intrinsics = Intrinsics(
            width=found.width,
            height=found.height,
            fx_px=found.fx,
            fy_px=found.fy,
            cx_px=found.ppx + 0.5,
            cy_px=found.ppy + 0.5,
            distortion=tuple(found.coeffs) if any(found.coeffs) else (),
        )

    def _lock(self, sensor: Any) -> None:
        """Fix exposure and white balance if the profile does; else leave both to the camera."""
        option, profile = sdk().option, self._profile
        exposure = profile.exposure_us and profile.exposure_us / EXPOSURE_UNIT_US
        for automatic, name, value in (
            (option.enable_auto_exposure, option.exposure, exposure),
            (option.enable_auto_white_balance, option.white_balance, profile.white_balance_k),
        ):
            if sensor.supports(automatic):
                sensor.set_option(automatic, float(value is None))
            if value is None:
                continue
            if not sensor.supports(name):
                raise NodeError(f"RealSense camera {self._serial} has no {name.name} to fix")
            sensor.set_option(name, value)
            took = sensor.get_option(name)
            if abs(took - value) > LOCK_TOLERANCE * value:
                raise NodeError(
                    f"RealSense camera {self._serial} takes {took:g} for {name.name}, not {value:g}"
                )

    def _complete(self, frame: Any) -> bool:
        """Add a frame; returns whether there is colour, and depth of the same moment if wanted.

        The library's own syncer waits by the expected times of both, and may not pair them at all.
        """
        if frame.get_profile().stream_type() == sdk().stream.depth:
            self._depth = frame.as_depth_frame()
        else:
            self._colour = frame.as_video_frame()
        if self._profile.depth_unit_m is None:
            return self._colour is not None
        if self._colour is None or self._depth is None:
            return False
        apart_ms = abs(self._colour.get_timestamp() - self._depth.get_timestamp())
        return apart_ms <= 500 / self._colour.get_profile().fps()

    def _captured_ns(self, arrival_ns: int) -> int:
        frame = self._colour
        self.stamp_ns = stamp_ns = round(frame.get_timestamp() * 1e6)
        if frame.get_frame_timestamp_domain() == sdk().timestamp_domain.hardware_clock:
            return self._clock.host_ns(stamp_ns, arrival_ns)
        # The library has brought it to this computer's wall clock already.
        return min(arrival_ns, arrival_ns - (time.time_ns() - stamp_ns))


def _frameset(*frames: Any) -> Any:
    """The frames as one frameset, which the library's filters take."""
    rs, out = sdk(), sdk().frame_queue(1)
    join = rs.processing_block(
        lambda _, source: source.frame_ready(source.allocate_composite_frame(list(frames)))
    )
    join.start(out)
    join.invoke(frames[0])
    return out.wait_for_frame().as_frameset()
