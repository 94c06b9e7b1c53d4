"""The forms in which one camera's pictures are made for others: in a model's size, for a host."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import zenoh

from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.camera.rate_limiter import Pace
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import form_for, prepare
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Event, Image

MAX_SIZES = 8
"""Sizes in which pictures are made for models; those of more models take what all get."""


@dataclass(frozen=True, slots=True)
class Form:
    """A way in which pictures are made for others.

    Args:
        stream: where they go.
        quality: of JPEG.
        pace: None: all of them.
        spec: whose size they have, None: their own.
        width: wider ones are made smaller.
    """

    stream: Publisher
    quality: int
    pace: Pace | None
    spec: CameraSpec | None = None
    width: int | None = None

    def made_of(self, image: Image) -> bytes:
        """The JPEG file of a picture."""
        if self.spec is None:
            return encode_jpeg(narrowed(image, self.width), self.quality)
        return encode_jpeg(Image(prepare(image, self.spec)), self.quality)


def narrowed(image: Image, widest: int | None) -> Image:
    """The picture, made smaller where it is wider than `widest`; its aspect ratio stays."""
    height, width = image.rgb.shape[:2]
    if widest is None or width <= widest:
        return image
    smaller = CameraSpec(
        camera="any", width=widest, height=max(8, round(height * widest / width)), resize="stretch"
    )
    return Image(prepare(image, smaller))


class Forms:
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
            Form(self._stream(form_for(host)), one.quality, _pace(one.rate_hz), width=one.width)
            for host, one in self._hosts.items()
        ]
        self._sizes: dict[str, list[Form]] = {}
        self._left_out: frozenset[str] = frozenset()

    # -- for who draws ------------------------------------------------------------------------
    @property
    def wanted(self) -> bool:
        """Somebody listens."""
        with self._lock:
            return any(form.stream.has_subscribers for form in self._all())

    def due(self, mono_ns: int) -> list[Form]:
        """Those in which somebody wants the picture of this time."""
        with self._lock:
            return [
                form
                for form in self._all()
                if form.stream.has_subscribers and (form.pace is None or form.pace.due(mono_ns))
            ]

    def put(self, form: Form, image: Image, stamp_wall_ns: int) -> None:
        """Write a picture in one of them; nowhere, if that was given back meanwhile."""
        jpeg, encoding = form.made_of(image), zenoh.Encoding.IMAGE_JPEG
        with self._lock:
            if any(form is one for one in self._all()):
                form.stream.publish(jpeg, stamp_wall_ns=stamp_wall_ns, encoding=encoding)

    def _all(self) -> list[Form]:
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
                name: any(form.stream.has_subscribers for form in forms)
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
        forms = [Form(self._stream(name), ours.jpeg_quality, _pace(ours.jpeg_rate_hz), rgb)]
        forms += [
            Form(self._stream(form_for(host, name)), one.quality, _pace(one.rate_hz), rgb)
            for host, one in self._hosts.items()
        ]
        with self._lock:
            self._sizes[name] = forms

    def _end(self, name: str) -> None:
        with self._lock:
            forms = self._sizes.pop(name)
            for form in forms:
                self._node.undeclare(form.stream)
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

    def _stream(self, form: str) -> Publisher:
        return self._node.declare_publisher(
            self._node.keys.camera_fitted(self._camera, form), Kind.FRAME
        )


def _pace(rate_hz: float | None) -> Pace | None:
    return None if rate_hz is None else Pace(rate_hz)
