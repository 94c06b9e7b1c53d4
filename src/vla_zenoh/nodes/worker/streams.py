"""What a worker receives of a robot: the image stream of each camera that suits the model best, and
its states."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, Wake, ZenohRing, header_of
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Kind
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import History, size_variant
from vla_zenoh.types import Event, SingleWriterFilter

STREAM_PATIENCE_S = 0.5
"""After this silence of a stream's writer another one is accepted."""
MAX_QUEUE = 96
PATIENCE_S, PERIODS = 1.0, 3
"""Without images on the preferred stream for this long, and for this many periods of a slow camera,
a worker subscribes to the common one as well."""


class ReceivedImage(NamedTuple):
    """A received image, and the writer filter and key of its stream."""

    arrival: ReceivedSample
    writer: SingleWriterFilter
    key: str


class _Stream(NamedTuple):
    key: str
    buffer: CallbackRing
    writer: SingleWriterFilter


class CameraSubscriber:
    """Subscriber of one camera: its preferred stream `key`, and after a silence of `patience_s` the
    common one, `fallback_key`, too.

    The newest image waits until it is taken; where those `history_s` older are needed as well, all
    of one inference do. Each sets `changed`.

    Raises:
        SessionError: the router does not answer at the port for images.
    """

    def __init__(
        self,
        node: Node,
        camera: str,
        key: str,
        fallback_key: str | None = None,
        *,
        patience_s: float = PATIENCE_S,
        changed: Wake,
        history_s: float = 0.0,
    ) -> None:
        self._node, self._camera, self._changed, self._queue = node, camera, changed, 1
        settings = node.profile.cameras.get(camera)
        if history_s and settings is not None:
            images = 1 + math.ceil((history_s + PATIENCE_S) * settings.rate_hz)
            self._queue = min(MAX_QUEUE, images)
        self._fallback_key, self._patience_s = fallback_key, patience_s
        self._preferred = self._subscribe(key)
        self._fallback: _Stream | None = None
        self._received_s = time.monotonic()

    @property
    def has_new(self) -> bool:
        """Whether there is an image that was not taken yet."""
        return self._preferred.buffer.has_new or (
            self._fallback is not None and self._fallback.buffer.has_new
        )

    def pop(self) -> ReceivedImage | None:
        """The newest image, once; of a queue the oldest."""
        arrival = self._preferred.buffer.pop()
        stream = self._preferred
        if arrival is not None:
            self._received_s = time.monotonic()
            if self._fallback is not None:
                self._node.unsubscribe(self._fallback.buffer)
                self._fallback = None
                why = f"there are images on {self._node.keys.short(stream.key)} again"
                self._node.emit(Event("info", "notice", f"{self._camera}:own_pictures", why))
        elif self._fallback is not None:
            stream = self._fallback
            arrival = stream.buffer.pop()
        elif self._fallback_key and time.monotonic() - self._received_s >= self._patience_s:
            self._fall_back(self._fallback_key)
        return None if arrival is None else ReceivedImage(arrival, stream.writer, stream.key)

    def _fall_back(self, key: str) -> None:
        self._fallback = self._subscribe(key)
        preferred, common = map(self._node.keys.short, (self._preferred.key, key))
        why = f"no image on {preferred} for {self._patience_s:g} s; subscribing to {common} as well"
        self._node.emit(Event("warning", "notice", f"{self._camera}:plain_pictures", why))

    def _subscribe(self, key: str) -> _Stream:
        ring = CallbackRing(self._queue, MAX_IMAGE_BYTES, self._changed)
        self._node.subscribe(key, ring, Kind.FRAME)
        return _Stream(key, ring, SingleWriterFilter(STREAM_PATIENCE_S))


def subscribe_to_camera(
    camera: CameraSpec, node: Node, *, jpeg: bool, changed: Wake, history_s: float
) -> CameraSubscriber:
    """Subscribe to the stream that suits a model: raw, JPEG, or JPEG in its input size."""
    keys, name = node.keys, camera.camera
    settings = node.profile.cameras.get(name)
    key, fallback = keys.camera_jpeg(name) if jpeg else keys.camera_raw(name), None
    if jpeg and settings is not None and settings.fit_for_workers:
        size = size_variant(camera)
        if size is not None:
            key, fallback = keys.camera_fitted(name, size), key
    rates_hz = (settings.rate_hz, settings.jpeg_rate_hz if jpeg else None) if settings else ()
    patience_s = max([PATIENCE_S, *(PERIODS / rate for rate in rates_hz if rate)])
    return CameraSubscriber(
        node, name, key, fallback, patience_s=patience_s, changed=changed, history_s=history_s
    )


class Feed(NamedTuple):
    """One camera's colour or depth images, from the subscriber to what is kept of them."""

    name: str
    camera: CameraSubscriber
    images: History
    decode: Callable[[bytes, str], Any]


class StateStream:
    """One stream of states, of at most `size` samples between two calls of `poll`, from these to
    `states`. Unless `every` one is needed, those that no image needs are not decoded."""

    def __init__(
        self, node: Node, key: str, kind: type[Any], states: History, size: int, *, every: bool
    ) -> None:
        self._node, self._kind, self._states, self._every = node, kind, states, every
        self._writer = SingleWriterFilter(STREAM_PATIENCE_S)
        ring = CallbackRing if every else ZenohRing
        self._ring: CallbackRing | ZenohRing = node.subscribe(key, ring(size, SMALL_BYTES))

    def poll(self, since_ns: int) -> None:
        """Decode what was received since the last call: the last before `since_ns`, and later."""
        arrivals = self._ring.drain()
        for arrival in arrivals if self._every else arrivals[self._first(arrivals, since_ns) :]:
            state = self._node.decode(self._kind, arrival, self._writer)
            if state is not None:
                self._states.add(state)

    def _first(self, arrivals: Sequence[ReceivedSample], since_ns: int) -> int:
        """The last that the writer measured before `since_ns`, or its first; not a repetition."""
        first = 0
        for number in reversed(range(len(arrivals))):
            try:
                header = header_of(arrivals[number].sample)
            except CodecError:
                continue
            if self._writer.is_next(header):
                first = number
                header, _ = self._node.clocks.to_local_clock(header, None)
                if header.stamp_wall_ns <= since_ns:
                    break
        return first
