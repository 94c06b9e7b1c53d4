"""The forms in which one camera's pictures are made for others: in a model's size, for a host."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import zenoh

from vla_zenoh.bus.node import Node, Stream
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.keys import Kind
from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.policy.observation import host_variant, prepare_image, size_variant
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Event, Image

EARLY = 0.25
LATE = 0.2


class RateLimiter:
    """Lets at most `rate_hz` pictures a second through, evenly and never in a burst.

    A picture may come `EARLY` periods before its time, so that a source of just this rate loses
    none to jitter. Lateness is carried over by `LATE` periods only. Together they stay under half
    a period: a source of twice the rate always gives every other picture.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._next_ns: float | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the picture of this time goes out; time may be of any clock."""
        ahead_ns = 0.0 if self._next_ns is None else self._next_ns - now_ns
        if ahead_ns > 2 * self._period_ns:  # that clock was set back
            self._next_ns, ahead_ns = None, 0.0
        if ahead_ns > EARLY * self._period_ns:
            return False
        start_ns = now_ns if self._next_ns is None else self._next_ns
        self._next_ns = max(start_ns, now_ns - LATE * self._period_ns) + self._period_ns
        return True


SILENCE_S = 5.0
"""A worker says its spec once a second; one that was silent for so long is gone."""
MAX_MODELS = 64


class RequestedSizes:
    """The newest spec of each worker, so that each of them asks for one size of a camera."""

    def __init__(self) -> None:
        self._specs: dict[str, tuple[float, ModelSpec]] = {}

    def hear(self, worker: str, spec: ModelSpec, now_s: float) -> bool:
        """Take a spec; False where there are too many already.

        Args:
            worker: whose it is, by its key.
            spec: what it says.
            now_s: any clock that only goes up.
        """
        self._forget(now_s)
        if worker not in self._specs and len(self._specs) >= MAX_MODELS:
            return False
        self._specs[worker] = (now_s, spec)
        return True

    def sizes(self, camera: str, now_s: float) -> dict[str, CameraSpec]:
        """Form -> what the model that asked for it said of it; who asked first comes first."""
        self._forget(now_s)
        wanted = (
            one
            for _, spec in self._specs.values()
            for one in spec.observation.cameras
            if one.camera == camera
        )
        forms = ((size_variant(one), one) for one in wanted)
        return {form: one for form, one in forms if form is not None}

    def _forget(self, now_s: float) -> None:
        for worker, (heard_s, _) in list(self._specs.items()):
            if now_s - heard_s > SILENCE_S:
                del self._specs[worker]


MAX_SIZES = 8
"""Sizes in which pictures are made for models; those of more models take what all get."""


@dataclass(frozen=True, slots=True)
class FittedStream:
    """A way in which pictures are made for others.

    Args:
        stream: where they go.
        quality: of JPEG.
        pace: None: all of them.
        spec: whose size they have, None: their own.
        width: wider ones are made smaller.
    """

    stream: Stream
    quality: int
    pace: RateLimiter | None
    spec: CameraSpec | None = None
    width: int | None = None

    def made_of(self, image: Image) -> bytes:
        """The JPEG file of a picture."""
        if self.spec is None:
            return encode_jpeg(shrink(image, self.width), self.quality)
        return encode_jpeg(Image(prepare_image(image, self.spec)), self.quality)


def shrink(image: Image, widest: int | None) -> Image:
    """The picture, made smaller where it is wider than `widest`; its aspect ratio stays."""
    height, width = image.rgb.shape[:2]
    if widest is None or width <= widest:
        return image
    smaller = CameraSpec(
        camera="any", width=widest, height=max(8, round(height * widest / width)), resize="stretch"
    )
    return Image(prepare_image(image, smaller))


class FittedStreams:
    """See the module. One thread draws, another one says in which sizes.

    Args:
        camera: its name.
        profile: what the profile says of it.
        node: on whose behalf.
        tell: writes an event; may be called from any thread.
    """

    def __init__(
        self, camera: str, profile: CameraProfile, node: Node, tell: Callable[[Event], None]
    ) -> None:
        self._camera, self._profile, self._node, self._tell = camera, profile, node, tell
        self._lock = threading.Lock()  # nobody draws for a stream that is being taken away
        self._hosts = {
            host: part.pictures
            for host, part in node.profile.hosts.items()
            if part.pictures is not None
        }
        self._whole = [
            FittedStream(
                self._stream(host_variant(host)), one.quality, _pace(one.rate_hz), width=one.width
            )
            for host, one in self._hosts.items()
        ]
        self._sizes: dict[str, list[FittedStream]] = {}
        self._left_out: frozenset[str] = frozenset()

    # -- for who draws ------------------------------------------------------------------------
    @property
    def wanted(self) -> bool:
        """Somebody listens."""
        with self._lock:
            return any(form.stream.wanted for form in self._all())

    def due(self, mono_ns: int) -> list[FittedStream]:
        """Those in which somebody wants the picture of this time."""
        with self._lock:
            return [
                form
                for form in self._all()
                if form.stream.wanted and (form.pace is None or form.pace.due(mono_ns))
            ]

    def put(self, form: FittedStream, image: Image, stamp_wall_ns: int) -> None:
        """Write a picture in one of them; nowhere, if that was given back meanwhile."""
        jpeg, encoding = form.made_of(image), zenoh.Encoding.IMAGE_JPEG
        with self._lock:
            if any(form is one for one in self._all()):
                form.stream.put(jpeg, stamp_wall_ns=stamp_wall_ns, encoding=encoding)

    def _all(self) -> list[FittedStream]:
        return [*self._whole, *(form for forms in self._sizes.values() for form in forms)]

    # -- for who hears models -----------------------------------------------------------------
    def serve(self, asked: Mapping[str, CameraSpec]) -> None:
        """Make pictures in the sizes that models ask for now, of no more than `MAX_SIZES`.

        A size that nobody asks for or listens to is given back, and one that is only listened to
        where another one is asked for and there is no room.

        Args:
            asked: form -> what a model says of it.
        """
        missing = [name for name in asked if name not in self._sizes]
        with self._lock:
            heard = {
                name: any(form.stream.wanted for form in forms)
                for name, forms in self._sizes.items()
                if name not in asked
            }
        ended = [name for name, listened in heard.items() if not listened]
        short = len(self._sizes) - len(ended) + len(missing) - MAX_SIZES
        ended += [name for name, listened in heard.items() if listened][: max(short, 0)]
        for name in ended:
            self._end(name)
        room = MAX_SIZES - len(self._sizes)
        for name in missing[:room]:
            self._begin(name, asked[name])
        self._tell_of(missing[room:])

    def _begin(self, name: str, spec: CameraSpec) -> None:
        rgb, ours = spec.model_copy(update={"colour": "rgb"}), self._profile
        forms = [FittedStream(self._stream(name), ours.jpeg_quality, _pace(ours.jpeg_rate_hz), rgb)]
        forms += [
            FittedStream(
                self._stream(host_variant(host, name)), one.quality, _pace(one.rate_hz), rgb
            )
            for host, one in self._hosts.items()
        ]
        with self._lock:
            self._sizes[name] = forms

    def _end(self, name: str) -> None:
        with self._lock:
            forms = self._sizes.pop(name)
            for form in forms:
                self._node.end(form.stream)
        why = f"pictures are no longer made as {name}: no living model asks for it"
        self._tell(Event("info", "notice", f"{self._camera}:size_given_back", why))

    def _tell_of(self, left_out: list[str]) -> None:
        before, self._left_out = self._left_out, frozenset(left_out)
        if self._left_out - before:
            why = (
                f"pictures are made in {MAX_SIZES} sizes for models at most; those who want "
                f"{', '.join(left_out)} take what all get"
            )
            self._tell(Event("warning", "notice", f"{self._camera}:too_many_sizes", why[:1000]))

    def _stream(self, form: str) -> Stream:
        return self._node.stream(self._node.keys.camera_fitted(self._camera, form), Kind.FRAME)


def _pace(rate_hz: float | None) -> RateLimiter | None:
    return None if rate_hz is None else RateLimiter(rate_hz)
