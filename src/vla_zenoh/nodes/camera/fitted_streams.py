"""Additional JPEG streams of one camera, each in the input size of a model."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import NamedTuple

import zenoh

from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.keys import Kind
from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.policy.observation import prepare_image, size_variant
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Event, Image

EARLY, LATE = 0.25, 0.2
"""Periods by which an image may be early, and by which lateness is carried over."""
MAX_SIZES = 8
"""Model input sizes served for one camera; further models use the common streams."""
SILENCE_S = 5.0
"""A worker publishes its spec once a second; after this silence it counts as gone."""
MAX_MODELS = 64


class RateLimiter:
    """Lets at most `rate_hz` images a second through, evenly spaced and never in a burst.

    An image may be `EARLY` periods early, so that a source of exactly this rate loses none to
    jitter. At most `LATE` periods of lateness are carried over. The two add up to less than half a
    period, so a source of twice the rate always passes every other image.

    Args:
        rate_hz: None: every image passes.
    """

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = None if rate_hz is None else 1e9 / rate_hz
        self._next_ns: float | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the image of this time, on any one clock, passes."""
        if self._period_ns is None:
            return True
        ahead_ns = 0.0 if self._next_ns is None else self._next_ns - now_ns
        if ahead_ns > 2 * self._period_ns:  # the clock was set back
            self._next_ns, ahead_ns = None, 0.0
        if ahead_ns > EARLY * self._period_ns:
            return False
        start_ns = now_ns if self._next_ns is None else self._next_ns
        self._next_ns = max(start_ns, now_ns - LATE * self._period_ns) + self._period_ns
        return True


class RequestedSizes:
    """Image sizes that live workers ask for, from the newest spec of each."""

    def __init__(self) -> None:
        self._specs: dict[str, tuple[float, ModelSpec]] = {}

    def add(self, worker: str, spec: ModelSpec, now_s: float) -> bool:
        """Keep a spec; False if there are `MAX_MODELS` of other workers already.

        Args:
            worker: whose it is, by its key.
            spec: as published.
            now_s: monotonic clock.
        """
        self._forget(now_s)
        if worker not in self._specs and len(self._specs) >= MAX_MODELS:
            return False
        self._specs[worker] = (now_s, spec)
        return True

    def sizes(self, camera: str, now_s: float) -> dict[str, CameraSpec]:
        """Variant name -> spec of the camera, in the order in which workers appeared."""
        self._forget(now_s)
        wanted = (
            one
            for _, spec in self._specs.values()
            for one in spec.observation.cameras
            if one.camera == camera
        )
        variants = ((size_variant(one), one) for one in wanted)
        return {variant: one for variant, one in variants if variant is not None}

    def _forget(self, now_s: float) -> None:
        for worker, (received_s, _) in list(self._specs.items()):
            if now_s - received_s > SILENCE_S:
                del self._specs[worker]


class FittedStream(NamedTuple):
    """One JPEG stream.

    Args:
        stream: publishes it.
        limiter: of its rate.
        spec: images are prepared for this model input.
    """

    stream: Publisher
    limiter: RateLimiter
    spec: CameraSpec


def shrink(image: Image, max_width: int | None) -> Image:
    """The image scaled down to `max_width`, with its aspect ratio, if it is wider."""
    height, width = image.rgb.shape[:2]
    if max_width is None or width <= max_width:
        return image
    smaller = CameraSpec(
        camera="any",
        width=max_width,
        height=max(8, round(height * max_width / width)),
        resize="stretch",
    )
    return Image(prepare_image(image, smaller))


class FittedStreams:
    """Fitted streams of one camera. One thread publishes images, another sets the sizes.

    Args:
        camera: its name.
        profile: its section of the profile.
        node: publishes the streams.
        emit: emits an event; callable from any thread.
    """

    def __init__(
        self, camera: str, profile: CameraProfile, node: Node, emit: Callable[[Event], None]
    ) -> None:
        self._camera, self._profile, self._node, self._emit = camera, profile, node, emit
        self._lock = threading.Lock()  # no image is published on a stream that is being removed
        self._streams: dict[str, FittedStream] = {}
        self._left_out: frozenset[str] = frozenset()

    # -- called by the capture thread ---------------------------------------------------------
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

    # -- called by the thread that receives specs ---------------------------------------------
    def serve(self, requested: Mapping[str, CameraSpec]) -> None:
        """Serve these sizes, at most `MAX_SIZES`.

        A size that is neither requested nor subscribed to is removed. One that is only subscribed
        to is removed if a requested one needs its place.

        Args:
            requested: variant name -> spec of the camera, see `RequestedSizes.sizes`.
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
            self._remove(name)
        room = MAX_SIZES - len(self._streams)
        for name in missing[:room]:
            self._add(name, requested[name])
        self._report_left_out(missing[room:])

    def _add(self, name: str, spec: CameraSpec) -> None:
        stream = self._node.declare_publisher(
            self._node.keys.camera_fitted(self._camera, name), Kind.FRAME
        )
        limiter = RateLimiter(self._profile.jpeg_rate_hz)
        fitted = FittedStream(stream, limiter, spec.model_copy(update={"colour": "rgb"}))
        with self._lock:
            self._streams[name] = fitted

    def _remove(self, name: str) -> None:
        with self._lock:
            self._node.undeclare(self._streams.pop(name).stream)
        why = f"images are no longer published as {name}: no live model requests this size"
        self._emit(Event("info", "notice", f"{self._camera}:size_given_back", why))

    def _report_left_out(self, left_out: list[str]) -> None:
        before, self._left_out = self._left_out, frozenset(left_out)
        if self._left_out - before:
            why = (
                f"images are published in at most {MAX_SIZES} model sizes; models that request "
                f"{', '.join(left_out)} receive the common stream"
            )
            self._emit(Event("warning", "notice", f"{self._camera}:too_many_sizes", why[:1000]))
