"""Publishes the images of one camera, and tracks its state, rate, latency and faults."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg, encode_raw, raw_schema
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.camera.fitted_streams import FittedStreams, RateLimiter, shrink
from vla_zenoh.nodes.camera.geometry import Geometry, Intrinsics, Pixels
from vla_zenoh.nodes.camera.image_check import ImageCheck, ImageFault
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Depth, Event, Image

WAITING, OK, LOST, ENDED = "waiting", "ok", "lost", "ended"
_SOURCE_LIMIT = 200
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}


class CameraPublisher:
    """Publisher of one camera: raw, JPEG, depth and fitted streams, each while it has subscribers.

    Used by the camera's own thread; another thread may read its status.

    Args:
        name: of the camera.
        profile: its section of the profile.
        shown: its source, without passwords.
        node: publishes the streams.
        emit: emits an event; callable from any thread.
        same_s: how long its source may repeat an identical image, s; 0: indefinitely.
        references: see `ImageCheck`.
    """

    def __init__(
        self,
        name: str,
        profile: CameraProfile,
        shown: str,
        node: Node,
        emit: Callable[[Event], None],
        same_s: float = 0.0,
        references: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> None:
        self.name, self.profile, self._references = name, profile, references
        self.backend = ""
        self.state, self.why = WAITING, "it is being opened"
        self.fault: ImageFault | None = None
        self._check = ImageCheck(name, profile.check, same_s, references)
        self.counts: Counter[str] = Counter()
        self._shown, self._clock, self._emit = shown[:_SOURCE_LIMIT], node.clock, emit
        self._raw = node.declare_publisher(node.keys.camera_raw(name), Kind.FRAME)
        self._jpeg = node.declare_publisher(node.keys.camera_jpeg(name), Kind.FRAME)
        self._depth = None
        if profile.depth_unit_m is not None:
            self._depth = node.declare_publisher(node.keys.camera_depth(name), Kind.FRAME)
        self._measured_share = 0.0
        self._geometry: Geometry | None = None
        self.intrinsics: Intrinsics | None = None
        """Of published images, where they are known; for status."""
        self.fitted = FittedStreams(name, profile, node, emit)
        self._limiter = RateLimiter(profile.rate_hz)
        self._jpeg_limiter = RateLimiter(profile.jpeg_rate_hz)
        self._seq = 0
        self._newest_mono_ns: int | None = None
        self._sizes: set[tuple[int, ...]] = set()
        self._lock = threading.Lock()  # of the meters
        self._rate = RateMeter()
        self._latency_ms = Percentiles(256)

    # -- state --------------------------------------------------------------------------------
    def set_state(self, state: str, why: str = "") -> None:
        """Enter `state`; emits an event on a new state, or on a new reason for a bad one."""
        if (state, why) == (self.state, self.why):
            return
        was, self.state, self.why = self.state, state, why
        if state == ENDED:
            self.fault = None
        level = "info" if state in (OK, ENDED) else "warning"
        if state != was:
            self._emit(Event(level, "transition", f"{self.name}:{was}->{state}", why[:1000]))
        else:
            self._emit(Event(level, "fault", f"{self.name}:{state}", why[:1000]))

    def set_waiting_reason(self, why: str) -> None:
        """Change the reason of `WAITING`, without an event."""
        if self.state == WAITING:
            self.why = why

    def lose(self, why: str) -> None:
        """Enter `LOST`, or `WAITING` before the first image: the source delivers nothing."""
        if self.state == OK:
            self.counts["losses"] += 1
        self.set_state(WAITING if self._newest_mono_ns is None else LOST, why)

    def count_broken(self) -> None:
        """Count an image that could not be decoded, and emit an event."""
        self.counts["broken"] += 1
        why = "an image could not be decoded and was skipped"
        self._emit(Event("warning", "fault", f"{self.name}:broken_picture", why))

    def captured(self, mono_ns: int) -> None:
        """The source has an image of this time, whether or not it is published."""
        self._newest_mono_ns = mono_ns

    def due(self, now_ns: int) -> bool:
        """Whether the image of this time is within `rate_hz`; counts it as available."""
        if not self._limiter.due(now_ns):
            return False
        with self._lock:
            self._rate.tick()
        return True

    # -- image faults -------------------------------------------------------------------------
    def opened(self, backend: str, same_s: float, intrinsics: Intrinsics | None = None) -> None:
        """The source was (re)opened: start the image check from scratch.

        Args:
            backend: of the source.
            same_s: how long it may repeat an identical image, s; 0: indefinitely.
            intrinsics: of its images, if it knows them.

        Raises:
            NodeError: the profile's intrinsics cannot be read.
        """
        self.backend, self._geometry = backend, Geometry(self.profile, intrinsics)
        self._check = ImageCheck(self.name, self.profile.check, same_s, self._references)

    def check(self, image: Pixels, mono_ns: int, stamp_ns: int | None = None) -> None:
        """Update `fault` from an image captured at `mono_ns` with the driver's `stamp_ns`."""
        before, self.fault = self.fault, self._check.update(image, mono_ns, stamp_ns)
        if self.fault is None:
            if before is not None:
                self._emit(Event("info", "notice", f"{self.name}:good", "its images are good"))
        elif before is None or before.what != self.fault.what:
            self.counts["bad"] += 1
            _, what, why, value, limit = self.fault
            self._emit(Event("warning", "fault", f"{self.name}:{what}", why, value, limit))

    # -- images -------------------------------------------------------------------------------
    @property
    def has_subscribers(self) -> bool:
        """Whether any stream has a subscriber."""
        streams = (self._raw, self._jpeg, self.fitted)
        return self.wants_depth or any(one.has_subscribers for one in streams)

    @property
    def wants_depth(self) -> bool:
        """Whether anyone subscribes to the depth stream."""
        return self._depth is not None and self._depth.has_subscribers

    def publish(self, image: Pixels, mono_ns: int, depth_m: Pixels | None = None) -> None:
        """Publish an image of OpenCV, captured at `mono_ns`, as the profile wants it.

        Args:
            image: of the source.
            mono_ns: time of capture, monotonic clock.
            depth_m: (H, W) of the same pixels, m.

        Raises:
            NodeError: unknown image format, or a crop beyond the image.
        """
        width, height, crop = self.profile.width, self.profile.height, self.profile.crop
        if image.shape[:2] != (height, width) and crop is None:
            self._count_resized(image.shape[:2])
        geometry = self._geometry or Geometry(self.profile)
        image = geometry.apply(image)
        self.intrinsics = geometry.intrinsics()
        if depth_m is not None:
            depth_m = geometry.apply(depth_m, depth=True)
        stamp_ns = self._clock.wall_ns() - (time.monotonic_ns() - mono_ns)
        self.publish_rgb(to_rgb(image), mono_ns, stamp_ns, depth_m)

    def publish_rgb(
        self,
        rgb: NDArray[np.uint8],
        mono_ns: int,
        stamp_wall_ns: int,
        depth_m: NDArray[Any] | None = None,
    ) -> None:
        """Publish an image of the profile's size on every stream that has subscribers.

        Args:
            rgb: (H, W, 3).
            mono_ns: time of capture, monotonic clock.
            stamp_wall_ns: the same on the wall clock.
            depth_m: (H, W) of the same view at the same time, in m, see `Depth.of_metres`.
        """
        image, raw = Image(rgb), self._raw.has_subscribers
        if raw:  # first: subscribers on this host need not wait for the rest
            encoding = zenoh.Encoding.ZENOH_BYTES.with_schema(raw_schema(image))
            self._raw.publish(
                encode_raw(image), stamp_wall_ns=stamp_wall_ns, seq=self._seq, encoding=encoding
            )
        fitted = self.fitted.due(mono_ns)
        jpeg = self._jpeg.has_subscribers and self._jpeg_limiter.due(mono_ns)
        depth = depth_m is not None and self.wants_depth
        if not (raw or jpeg or fitted or depth):
            return
        if jpeg:
            # A thinned stream numbers its own images.
            thinned = self.profile.jpeg_rate_hz is not None
            self._jpeg.publish(
                encode_jpeg(shrink(image, self.profile.jpeg_width), self.profile.jpeg_quality),
                stamp_wall_ns=stamp_wall_ns,
                seq=None if thinned else self._seq,
                encoding=zenoh.Encoding.IMAGE_JPEG,
            )
        for one in fitted:
            self.fitted.publish(one, image, stamp_wall_ns)
        if depth:
            self._publish_depth(depth_m, stamp_wall_ns)
        self._seq += 1
        with self._lock:
            self._latency_ms.add((time.monotonic_ns() - mono_ns) / 1e6)

    def _publish_depth(self, depth_m: Any, stamp_wall_ns: int) -> None:
        assert self._depth is not None and self.profile.depth_unit_m is not None
        depth = Depth.of_metres(depth_m, self.profile.depth_unit_m)
        self._measured_share = np.count_nonzero(depth.counts) / depth.counts.size
        self._depth.publish(
            encode_depth(depth),
            stamp_wall_ns=stamp_wall_ns,
            seq=self._seq,
            encoding=zenoh.Encoding.IMAGE_PNG.with_schema(depth_schema(depth)),
        )

    def _count_resized(self, size: tuple[int, ...]) -> None:
        self.counts["resized"] += 1
        if size in self._sizes:
            return
        self._sizes.add(size)
        why = (
            f"{self._shown} delivers images of {size[1]}x{size[0]}; they are stretched to "
            f"{self.profile.width}x{self.profile.height}, as the profile says"
        )
        self._emit(Event("info", "notice", f"{self.name}:resized", why))

    # -- status -------------------------------------------------------------------------------
    def detail(self) -> dict[str, Any]:
        """For status: state, source, back end, age of the newest image in s, fault, intrinsics."""
        newest = self._newest_mono_ns
        detail: dict[str, Any] = {
            "state": self.state,
            "source": self._shown,
            "backend": self.backend,
            "age_s": None if newest is None else (time.monotonic_ns() - newest) / 1e9,
        }
        if self.intrinsics is not None:
            detail["intrinsics"] = self.intrinsics.shown()
        if self._depth is not None:
            detail["depth_measured_share"] = round(self._measured_share, 3)
        if (bad := self.fault) is not None:
            names = ("why", "check", "value", "limit")
            detail["bad"] = {name: getattr(bad, name) for name in names}
        return detail | ({"why": self.why} if self.why else {})

    def figures(self) -> tuple[float, tuple[float, float] | None]:
        """Rate of available images in Hz, and latency from capture to publication in ms."""
        with self._lock:
            return self._rate.rate_hz, self._latency_ms.summary()

    def counters(self) -> dict[str, int]:
        """Counters for status, each prefixed with the camera's name."""
        counts = dict(self.counts) | {"raw": self._raw.seq, "jpeg": self._jpeg.seq}
        if self._depth is not None:
            counts["depth"] = self._depth.seq
        return {f"{self.name}.{what}": count for what, count in counts.items()}


def to_rgb(image: Pixels) -> NDArray[np.uint8]:
    """Convert grey, BGR or BGRA of 8 or 16 bits to RGB uint8 (H, W, 3).

    Raises:
        NodeError: any other format.
    """
    channels = 1 if image.ndim == 2 else image.shape[2] if image.ndim == 3 else 0
    if channels not in _TO_RGB or image.dtype not in (np.uint8, np.uint16):
        raise NodeError(
            f"an image of shape {image.shape} and type {image.dtype} cannot be shown; "
            "wanted 1, 3 or 4 channels of 8 or 16 bits"
        )
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    return np.asarray(cv2.cvtColor(image, _TO_RGB[channels]), np.uint8)
