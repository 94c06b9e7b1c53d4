"""Publishes the images of one camera, also in the input sizes of models, and tracks its state."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg, encode_raw, raw_schema
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import OPENING, Kind
from vla_zenoh.nodes.camera.geometry import Geometry, Intrinsics, Pixels, resize
from vla_zenoh.nodes.camera.image_check import ImageCheck, ImageFault
from vla_zenoh.opencv import cv2
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import prepare_image
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Depth, Event, Image

WAITING, OK, LOST = "waiting", "ok", "lost"
_SOURCE_LIMIT = 200
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}

EARLY, LATE = 0.25, 0.2
"""Periods by which an image may be early, and by which lateness is carried over."""
MAX_SIZES = 8
"""Model input sizes served for one camera; further models use the common streams."""


class RateLimiter:
    """Lets at most `rate_hz` images a second through, evenly spaced; None: all.

    An image may be `EARLY` periods early, so that a source of exactly this rate loses none to
    jitter. At most `LATE` periods of lateness are carried over. The two add up to less than half a
    period, so a source of twice the rate always passes every other image.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else 1e9 / rate_hz
        self._next_ns: float | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the image of this time, on any one clock, passes."""
        if self._period_ns is None:
            return True
        next_ns = now_ns if self._next_ns is None else self._next_ns
        if next_ns - now_ns > 2 * self._period_ns:  # the clock was set back
            next_ns = now_ns
        if next_ns - now_ns > EARLY * self._period_ns:
            return False
        self._next_ns = max(next_ns, now_ns - LATE * self._period_ns) + self._period_ns
        return True


class FittedStream(NamedTuple):
    """A JPEG stream of images prepared for the model input `spec`."""

    stream: Publisher
    limiter: RateLimiter
    spec: CameraSpec


class FittedStreams:
    """Fitted streams of one camera. One thread publishes images, another sets the sizes."""

    def __init__(
        self, camera: str, profile: CameraProfile, node: Node, emit: Callable[[Event], None]
    ) -> None:
        self._camera, self._profile, self._node, self._emit = camera, profile, node, emit
        self._lock = threading.Lock()  # no image is published on a stream that is being removed
        self._streams: dict[str, FittedStream] = {}
        self._left_out: frozenset[str] = frozenset()

    @property
    def has_subscribers(self) -> bool:
        """Whether any of the streams has a subscriber."""
        with self._lock:
            return any(one.stream.has_subscribers for one in self._streams.values())

    def due(self, mono_ns: int) -> list[FittedStream]:
        """Streams that have a subscriber and are due for the image of this time."""
        if not self._streams:
            return []
        with self._lock:
            return [
                one
                for one in self._streams.values()
                if one.stream.has_subscribers and one.limiter.due(mono_ns)
            ]

    def publish(self, fitted: FittedStream, image: Image, stamp_wall_ns: int) -> None:
        """Publish an image on one of the streams, unless it was removed in the meantime."""
        jpeg = encode_jpeg(Image(prepare_image(image, fitted.spec)), self._profile.jpeg_quality)
        with self._lock:
            if any(fitted is one for one in self._streams.values()):
                fitted.stream.publish(
                    jpeg, stamp_wall_ns=stamp_wall_ns, encoding=zenoh.Encoding.IMAGE_JPEG
                )

    def serve(self, requested: Mapping[str, CameraSpec]) -> None:
        """Serve these sizes, by variant name, at most `MAX_SIZES`.

        A size that is neither requested nor subscribed to is removed. One that is only subscribed
        to is removed if a requested one needs its place.
        """
        missing = [name for name in requested if name not in self._streams]
        with self._lock:
            unrequested = {
                name: one.stream.has_subscribers
                for name, one in self._streams.items()
                if name not in requested
            }
        ended = [name for name, subscribed in unrequested.items() if not subscribed]
        short = len(self._streams) - len(ended) + len(missing) - MAX_SIZES
        ended += [name for name, subscribed in unrequested.items() if subscribed][: max(short, 0)]
        for name in ended:
            with self._lock:
                self._node.undeclare(self._streams.pop(name).stream)
            why = f"images are no longer published as {name}: no live model requests this size"
            self._emit(Event("info", "notice", f"{self._camera}:size_given_back", why))
        room = MAX_SIZES - len(self._streams)
        for name in missing[:room]:
            key = self._node.keys.camera_fitted(self._camera, name)
            stream = self._node.declare_publisher(key, Kind.FRAME)
            limiter = RateLimiter(self._profile.jpeg_rate_hz)
            spec = requested[name].model_copy(update={"colour": "rgb"})
            with self._lock:
                self._streams[name] = FittedStream(stream, limiter, spec)
        before, self._left_out = self._left_out, frozenset(missing[room:])
        if self._left_out - before:
            why = (
                f"images are published in at most {MAX_SIZES} model sizes; models that request "
                f"{', '.join(missing[room:])} receive the common stream"
            )
            self._emit(Event("warning", "notice", f"{self._camera}:too_many_sizes", why[:1000]))


class CameraPublisher:
    """Publisher of one camera: raw, JPEG, depth and fitted streams, each while it has subscribers.

    Used by the camera's own thread; another thread may read its status. `shown` is its source
    without passwords; for `same_s` and `references` see `ImageCheck`.
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
        self.state, self.why = WAITING, OPENING
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
        self._source_shape: tuple[int, ...] = ()
        self.intrinsics: dict[str, float] = {}
        """Of published images, as status shows them; empty: unknown."""
        self.fitted = FittedStreams(name, profile, node, emit)
        self._limiter = RateLimiter(profile.rate_hz)
        self._jpeg_limiter = RateLimiter(profile.jpeg_rate_hz)
        self._seq = 0
        self._newest_mono_ns: int | None = None
        self._sizes: set[tuple[int, ...]] = set()
        self._lock = threading.Lock()  # of the meters
        self._rate = RateMeter()
        self._latency_ms = Percentiles(256)

    def set_state(self, state: str, why: str = "") -> None:
        """Enter `state`; emits an event on a new state, or on a new reason for a bad one."""
        if (state, why) == (self.state, self.why):
            return
        was, self.state, self.why = self.state, state, why
        level = "info" if state == OK else "warning"
        kind, change = ("fault", state) if state == was else ("transition", f"{was}->{state}")
        self._emit(Event(level, kind, f"{self.name}:{change}", why[:1000]))

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

    def opened(self, backend: str, same_s: float, intrinsics: Intrinsics | None = None) -> None:
        """The source was (re)opened: start the image check from scratch.

        Raises:
            NodeError: the profile's intrinsics cannot be read.
        """
        self.backend, self._geometry = backend, Geometry(self.profile, intrinsics)
        self._source_shape = ()
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
        """Publish an image of an opened source, captured at `mono_ns`, as the profile wants it.

        `depth_m`: (H, W) of the same pixels.

        Raises:
            NodeError: unknown image format, or a crop beyond the image.
        """
        width, height, crop = self.profile.width, self.profile.height, self.profile.crop
        if image.shape[:2] != (height, width) and crop is None:
            self._count_resized(image.shape[:2])
        assert self._geometry is not None
        shape, image = image.shape, self._geometry.apply(image)
        if shape != self._source_shape:
            self._source_shape, intrinsics = shape, self._geometry.intrinsics()
            self.intrinsics = {} if intrinsics is None else intrinsics.shown()
        if depth_m is not None:
            depth_m = self._geometry.apply(depth_m, depth=True)
        stamp_ns = self._clock.wall_ns() - (time.monotonic_ns() - mono_ns)
        self.publish_rgb(to_rgb(image), mono_ns, stamp_ns, depth_m)

    def publish_rgb(
        self,
        rgb: NDArray[np.uint8],
        mono_ns: int,
        stamp_wall_ns: int,
        depth_m: NDArray[Any] | None = None,
    ) -> None:
        """Publish an image (H, W, 3) of the profile's size on every stream that has subscribers.

        The time of capture is given on the monotonic and on the wall clock; `depth_m` (H, W) is of
        the same view and time, see `Depth.of_metres`.
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
                encode_jpeg(_shrink(image, self.profile.jpeg_width), self.profile.jpeg_quality),
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

    def detail(self) -> dict[str, Any]:
        """For status: state, source, back end, age of the newest image in s, fault, intrinsics."""
        newest = self._newest_mono_ns
        detail: dict[str, Any] = {
            "state": self.state,
            "source": self._shown,
            "backend": self.backend,
            "age_s": None if newest is None else (time.monotonic_ns() - newest) / 1e9,
        }
        if self.intrinsics:
            detail["intrinsics"] = self.intrinsics
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
        streams = {"raw": self._raw, "jpeg": self._jpeg, "depth": self._depth}
        counts = {what: stream.seq for what, stream in streams.items() if stream is not None}
        return {f"{self.name}.{what}": count for what, count in {**self.counts, **counts}.items()}


def _shrink(image: Image, max_width: int | None) -> Image:
    """The image scaled down to `max_width`, with its aspect ratio, if it is wider."""
    height, width = image.rgb.shape[:2]
    if max_width is None or width <= max_width:
        return image
    return Image(resize(image.rgb, max_width, max(8, round(height * max_width / width))))


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
