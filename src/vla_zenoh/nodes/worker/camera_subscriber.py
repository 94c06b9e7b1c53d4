"""One camera as a worker hears it: in the form it asked for, else as everybody gets it."""

from __future__ import annotations

import threading
import time
from typing import NamedTuple

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.keys import Kind
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import host_variant, size_variant
from vla_zenoh.types import Event
from vla_zenoh.types.stream import SingleWriterFilter

STREAM_PATIENCE_S = 0.5
"""Another camera is believed when the one before it was silent for so long."""
PATIENCE_S, PERIODS = 1.0, 3
"""Without pictures in the form it asked for, for so long and so many periods of a slow camera, a
worker takes those that all get."""


class ReceivedImage(NamedTuple):
    """A picture, and who may speak on its key."""

    arrival: ReceivedSample
    speaker: SingleWriterFilter


class _Ear(NamedTuple):
    key: str
    slot: LatestSample
    speaker: SingleWriterFilter


class CameraSubscriber:
    """See the module. While what was asked for comes, nothing else travels.

    Args:
        node: the worker's.
        camera: its name.
        key: where pictures are as the worker wants them.
        plain_key: where they are for all, None where that is the same.
        patience_s: without pictures on `key` for so long, those on `plain_key` are taken.
        changed: is notified when a picture arrives.

    Raises:
        SessionError: the router does not answer at the port of pictures.
    """

    def __init__(
        self,
        node: Node,
        camera: str,
        key: str,
        plain_key: str | None,
        *,
        patience_s: float,
        changed: threading.Condition,
    ) -> None:
        self._node, self._camera, self._changed = node, camera, changed
        self._plain_key, self._patience_s = plain_key, patience_s
        self._asked = self._listen(key)
        self._plain: _Ear | None = None
        self._heard_s = time.monotonic()

    @property
    def full(self) -> bool:
        """Whether a picture is there that was not taken."""
        return self._asked.slot.has_new or (self._plain is not None and self._plain.slot.has_new)

    def take(self) -> ReceivedImage | None:
        """The newest picture, once."""
        arrival = self._asked.slot.pop()
        if arrival is not None:
            self._heard_s = time.monotonic()
            self._ask_no_more()
            return ReceivedImage(arrival, self._asked.speaker)
        if self._plain is None:
            self._fall_back()
            return None
        arrival = self._plain.slot.pop()
        return None if arrival is None else ReceivedImage(arrival, self._plain.speaker)

    def _fall_back(self) -> None:
        if self._plain_key is None or time.monotonic() - self._heard_s < self._patience_s:
            return
        self._plain = self._listen(self._plain_key)
        asked, plain = (self._node.keys.short(one.key) for one in (self._asked, self._plain))
        why = f"no picture on {asked} for {self._patience_s:g} s; {plain} is listened to as well"
        self._node.emit(Event("warning", "notice", f"{self._camera}:plain_pictures", why))

    def _ask_no_more(self) -> None:
        if self._plain is None:
            return
        self._node.unsubscribe(self._plain.slot)
        self._plain = None
        why = f"there are pictures on {self._node.keys.short(self._asked.key)} again"
        self._node.emit(Event("info", "notice", f"{self._camera}:own_pictures", why))

    def _listen(self, key: str) -> _Ear:
        slot = self._node.subscribe(key, LatestSample(MAX_IMAGE_BYTES, self._changed), Kind.FRAME)
        return _Ear(key, slot, SingleWriterFilter(STREAM_PATIENCE_S))


def subscribe_to_camera(
    camera: CameraSpec, node: Node, *, jpeg: bool, host: str | None, changed: threading.Condition
) -> CameraSubscriber:
    """Listen where the pictures are that a model wants.

    Args:
        camera: what the model says of it.
        node: the worker's.
        jpeg: take JPEG, not raw pictures.
        host: of the profile, on which this runs: some have a say in what travels there.
        changed: is notified when a picture arrives.

    Raises:
        SessionError: the router does not answer at the port of pictures.
    """
    keys, name = node.keys, camera.camera
    settings, part = node.profile.cameras.get(name), node.profile.hosts.get(host or "")
    key, plain, rates_hz = keys.camera_raw(name), None, [settings.rate_hz if settings else None]
    if jpeg:
        key = keys.camera_jpeg(name)
        size = size_variant(camera) if settings is not None and settings.fit_for_workers else None
        rates_hz.append(settings.jpeg_rate_hz if settings else None)
        if host is not None and part is not None and part.pictures is not None:
            key, rates_hz[1] = keys.camera_fitted(name, host_variant(host)), part.pictures.rate_hz
            size = None if size is None else host_variant(host, size)
        if size is not None:
            key, plain = keys.camera_fitted(name, size), key
    patience_s = max([PATIENCE_S, *(PERIODS / rate for rate in rates_hz if rate)])
    return CameraSubscriber(node, name, key, plain, patience_s=patience_s, changed=changed)
