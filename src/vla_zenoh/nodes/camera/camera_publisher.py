"""The way out of one camera: its two keys, its pace, and what is known of it."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import encode_jpeg, encode_raw, raw_schema
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.camera.fitted_streams import FittedStreams, RateLimiter, shrink
from vla_zenoh.nodes.camera.image_check import ImageCheck, ImageFault
from vla_zenoh.nodes.camera.source import Pixels
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Event, Image

WAITING, OK, LOST, ENDED = "waiting", "ok", "lost", "ended"
_SOURCE_LIMIT = 200


class CameraPublisher:
    """One camera's keys. Written by one thread, read by the one that reports.

    Args:
        name: the camera's.
        profile: what the profile says of it.
        shown: its source as people may read it, without passwords.
        node: the node on whose behalf it writes.
        tell: writes an event; may be called from any thread.
        same_s: so long its source may give the very same picture; 0: for ever.
    """

    def __init__(
        self,
        name: str,
        profile: CameraProfile,
        shown: str,
        node: Node,
        tell: Callable[[Event], None],
        same_s: float = 0.0,
    ) -> None:
        self.name, self.profile = name, profile
        self.backend = ""
        self.state, self.why = WAITING, "it is being opened"
        self.bad: ImageFault | None = None
        self._check = ImageCheck(name, profile.check, same_s)
        self.counts: Counter[str] = Counter()
        self.pace = RateLimiter(profile.rate_hz)
        self._shown, self._clock, self._tell = shown[:_SOURCE_LIMIT], node.clock, tell
        self._raw = node.declare_publisher(node.keys.camera_raw(name), Kind.FRAME)
        self._jpeg = node.declare_publisher(node.keys.camera_jpeg(name), Kind.FRAME)
        self.forms = FittedStreams(name, profile, node, tell)
        self._jpeg_pace = RateLimiter(profile.jpeg_rate_hz)
        self._seq = 0
        self._newest_mono_ns: int | None = None
        self._sizes: set[tuple[int, ...]] = set()
        self._lock = threading.Lock()  # of the meters
        self._rate = RateMeter()
        self._latency_ms = Percentiles(256)

    # -- state --------------------------------------------------------------------------------
    def change(self, state: str, why: str = "") -> None:
        """Be in `state`; a new state, or another reason for a bad one, is told."""
        if (state, why) == (self.state, self.why):
            return
        was, self.state, self.why = self.state, state, why
        if state == ENDED:
            self.bad = None
        level = "info" if state in (OK, ENDED) else "warning"
        if state != was:
            self._tell(Event(level, "transition", f"{self.name}:{was}->{state}", why[:1000]))
        else:
            self._tell(Event(level, "fault", f"{self.name}:{state}", why[:1000]))

    def wait(self, why: str) -> None:
        """Wait for something that is about to come: nothing to be told."""
        if self.state == WAITING:
            self.why = why

    def lose(self, why: str) -> None:
        """No picture can be had for now."""
        if self.state == OK:
            self.counts["losses"] += 1
        self.change(WAITING if self._newest_mono_ns is None else LOST, why)

    def broken(self) -> None:
        """A single picture could not be decoded, and is left out."""
        self.counts["broken"] += 1
        self._tell(
            Event(
                "warning",
                "fault",
                f"{self.name}:broken_picture",
                "a picture could not be decoded and was left out",
            )
        )

    def seen(self, mono_ns: int) -> None:
        """A picture of this time is to be had, whether anybody wants it or not."""
        self._newest_mono_ns = mono_ns

    def in_time(self, now_ns: int) -> bool:
        """Whether the picture of this time is one of the `rate_hz` a second."""
        if not self.pace.due(now_ns):
            return False
        with self._lock:
            self._rate.tick()
        return True

    # -- what is wrong with it ----------------------------------------------------------------
    def opened(self, backend: str, same_s: float) -> None:
        """Its source is open, anew: its pictures have nothing to do with those before."""
        self.backend = backend
        self._check = ImageCheck(self.name, self.profile.check, same_s)

    def look(self, picture: Pixels, mono_ns: int, stamp_ns: int | None = None) -> None:
        """Judge the camera by a picture of this time, and by the time its driver says."""
        before, self.bad = self.bad, self._check.look(picture, mono_ns, stamp_ns)
        if self.bad is None:
            if before is not None:
                self._tell(Event("info", "notice", f"{self.name}:good", "its pictures are good"))
        elif before is None or before.what != self.bad.what:
            self.counts["bad"] += 1
            _, what, why, value, limit = self.bad
            self._tell(Event("warning", "fault", f"{self.name}:{what}", why, value, limit))

    # -- pictures -----------------------------------------------------------------------------
    @property
    def wanted(self) -> bool:
        """Somebody listens."""
        return self._raw.has_subscribers or self._jpeg.has_subscribers or self.forms.wanted

    def put(self, picture: Pixels, mono_ns: int) -> None:
        """Write what OpenCV gave, captured at `mono_ns`, in the profile's size.

        Raises:
            NodeError: it is no picture that can be shown.
        """
        width, height = self.profile.width, self.profile.height
        if picture.shape[:2] != (height, width):
            self._count_size(picture.shape[:2])
        stamp_ns = self._clock.wall_ns() - (time.monotonic_ns() - mono_ns)
        self.put_rgb(to_rgb(resize(picture, width, height)), mono_ns, stamp_ns)

    def put_rgb(self, rgb: NDArray[np.uint8], mono_ns: int, stamp_wall_ns: int) -> None:
        """Write a finished picture, in each form that somebody listens to."""
        raw, jpeg = self._raw.has_subscribers, self._jpeg.has_subscribers
        fitted = self.forms.due(mono_ns)
        thinned = self.profile.jpeg_rate_hz is not None
        jpeg = jpeg and self._jpeg_pace.due(mono_ns)
        if not (raw or jpeg or fitted):
            return
        image = Image(rgb)
        if raw:
            schema = zenoh.Encoding.ZENOH_BYTES.with_schema(raw_schema(image))
            self._raw.publish(
                encode_raw(image), stamp_wall_ns=stamp_wall_ns, seq=self._seq, encoding=schema
            )
        if jpeg:
            # Where not all of them go out, those that do have numbers of their own.
            self._jpeg.publish(
                encode_jpeg(shrink(image, self.profile.jpeg_width), self.profile.jpeg_quality),
                stamp_wall_ns=stamp_wall_ns,
                seq=None if thinned else self._seq,
                encoding=zenoh.Encoding.IMAGE_JPEG,
            )
        for form in fitted:
            self.forms.publish(form, image, stamp_wall_ns)
        self._seq += 1
        with self._lock:
            self._latency_ms.add((time.monotonic_ns() - mono_ns) / 1e6)

    def _count_size(self, size: tuple[int, ...]) -> None:
        self.counts["resized"] += 1
        if size in self._sizes:
            return
        self._sizes.add(size)
        self._tell(
            Event(
                "info",
                "notice",
                f"{self.name}:resized",
                f"{self._shown} gives pictures of {size[1]}x{size[0]}; they are stretched to "
                f"{self.profile.width}x{self.profile.height}, as the profile says",
            )
        )

    # -- what is reported ---------------------------------------------------------------------
    def detail(self) -> dict[str, Any]:
        """For status: state, source, back end, age of the newest picture, what is wrong with it."""
        newest = self._newest_mono_ns
        told: dict[str, Any] = {
            "state": self.state,
            "source": self._shown,
            "backend": self.backend,
            "age_s": None if newest is None else (time.monotonic_ns() - newest) / 1e9,
        }
        if (bad := self.bad) is not None:
            told["bad"] = {name: getattr(bad, name) for name in ("why", "check", "value", "limit")}
        return told | ({"why": self.why} if self.why else {})

    def figures(self) -> tuple[float, tuple[float, float] | None]:
        """Pictures per second that are there to be had, and ms from capture until they are put."""
        with self._lock:
            return self._rate.rate_hz, self._latency_ms.summary()

    def counters(self) -> dict[str, int]:
        """For status, named after the camera."""
        counts = dict(self.counts) | {"raw": self._raw.seq, "jpeg": self._jpeg.seq}
        return {f"{self.name}.{what}": count for what, count in counts.items()}


_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}


def resize(picture: Pixels, width: int, height: int) -> Pixels:
    """Stretch to (height, width): averaging when it shrinks, linear when it grows."""
    had_height, had_width = picture.shape[:2]
    if (had_height, had_width) == (height, width):
        return picture
    shrinks = width * height < had_width * had_height
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=method)


def to_rgb(picture: Pixels) -> NDArray[np.uint8]:
    """Grey, BGR or BGRA of 8 or 16 bits to RGB uint8 (H, W, 3).

    Raises:
        NodeError: it is none of these.
    """
    channels = 1 if picture.ndim == 2 else picture.shape[2] if picture.ndim == 3 else 0
    if channels not in _TO_RGB or picture.dtype not in (np.uint8, np.uint16):
        raise NodeError(
            f"a picture of shape {picture.shape} and type {picture.dtype} cannot be shown; "
            "wanted 1, 3 or 4 channels of 8 or 16 bits"
        )
    if picture.dtype == np.uint16:
        picture = (picture >> 8).astype(np.uint8)
    return np.asarray(cv2.cvtColor(picture, _TO_RGB[channels]), np.uint8)
