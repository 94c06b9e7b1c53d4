"""Pictures for pages: newest JPEG, or depth, of each stream that some page looks at."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.client.client import Client
from vla_zenoh.codec.image import decode_depth, encode_jpeg
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.lab.newest_records import StreamSlot
from vla_zenoh.lab.rate_limit import RateLimit
from vla_zenoh.profile import CameraProfile
from vla_zenoh.types import Image
from vla_zenoh_web.requests import DrawnRequest, LookRequest, parse

MAX_PICTURE_BYTES = 4 * 1024 * 1024
MAX_STREAMS = 32
"""Of all pages together."""
JPEG_START = b"\xff\xd8"
NEAR_PERCENT, FAR_PERCENT = 1.0, 99.0
MAX_PICTURE_HZ, IN_FLIGHT = 30.0, 2
"""Pictures sent that a page has not drawn yet: with more, a slow one would see the past."""
SPARSE = 4
"""One row and column in this many says how near and far a depth picture goes."""


class Picture(NamedTuple):
    """A picture.

    Args:
        stamp_wall_ns: capture, clock of its camera.
        said: which distances its colours mean, of a depth picture.
    """

    jpeg: bytes
    stamp_wall_ns: int
    said: str


class _Stream:
    def __init__(self, client: Client, key: str) -> None:
        self.latest = StreamSlot(MAX_PICTURE_BYTES)
        self.end = client.watch(key, self.latest)
        self.users = 0


class Pictures:
    """Subscriptions to pictures, each while at least one page wants it: cameras and workers publish
    them because of these. Safe to use from several threads.

    Attributes:
        offered: streams of the cameras: ``camera/NAME``, and ``depth/NAME`` where it measures it.
    """

    def __init__(self, client: Client, cameras: Mapping[str, CameraProfile]) -> None:
        self._client, self._keys = client, client.keys
        self.offered = tuple(f"camera/{name}" for name in cameras) + tuple(
            f"depth/{name}" for name, camera in cameras.items() if camera.depth_unit_m is not None
        )
        self._streams: dict[str, _Stream] = {}
        self._lock = threading.Lock()
        self.rejected: Counter[str] = Counter()

    def _key(self, name: str) -> str:
        """Key of ``camera/NAME``, ``depth/NAME`` or ``seen/WORKER/CAMERA``.

        Raises:
            CodecError: there is no such stream.
        """
        kind, _, rest = name.partition("/")
        try:
            if kind == "camera" and name in self.offered:
                return self._keys.camera_jpeg(rest)
            if kind == "depth" and name in self.offered:
                return self._keys.camera_depth(rest)
            if kind == "seen" and rest.count("/") == 1:
                return self._keys.seen(*rest.split("/"))
        except ProfileError as error:
            raise CodecError("malformed", str(error)) from error
        raise CodecError("malformed", f"no pictures are called {name[:100]!r}")

    def change(self, before: Iterable[str], wanted: Iterable[str]) -> None:
        """A page wants other streams than before.

        Raises:
            CodecError: one is not there, or they are too many; nothing has changed.
        """
        before, wanted = set(before), set(wanted)
        keys = {name: self._key(name) for name in wanted - before}
        with self._lock:
            if len(self._streams.keys() | wanted) > MAX_STREAMS:
                raise CodecError("malformed", f"at most {MAX_STREAMS} streams of pictures")
            for name, key in keys.items():
                if name not in self._streams:
                    self._streams[name] = _Stream(self._client, key)
                self._streams[name].users += 1
            for name in before - wanted:
                self._streams[name].users -= 1
            unused = [name for name, stream in self._streams.items() if not stream.users]
            gone = [self._streams.pop(name) for name in unused]
        for stream in gone:
            stream.end()

    def count(self, name: str) -> int:
        stream = self._streams.get(name)
        return 0 if stream is None else stream.latest.count

    def newest(self, name: str) -> Picture | None:
        """The newest picture of a stream; None before the first, or if it cannot be read.

        That of a depth stream is made of it, in colours from near (red) to far (blue), which takes
        some milliseconds.
        """
        stream = self._streams.get(name)
        sample = None if stream is None else stream.latest.arrival
        if sample is None:
            return None
        try:
            jpeg, said = bytes_of(sample.sample.payload, MAX_PICTURE_BYTES), ""
            if name.startswith("depth/"):
                jpeg, said = _coloured(jpeg, str(sample.sample.encoding))
            if not jpeg.startswith(JPEG_START):
                raise CodecError("malformed", "no JPEG file")
            return Picture(jpeg, header_of(sample.sample).stamp_wall_ns, said)
        except CodecError as error:
            self.rejected[error.reason] += 1
            return None


def _coloured(png: bytes, encoding: str) -> tuple[bytes, str]:
    """A depth picture as JPEG, and which distances its colours mean.

    Raises:
        CodecError: it is no depth picture.
    """
    from vla_zenoh.opencv import cv2

    depth = decode_depth(png, encoding.partition(";")[2])
    sparse = depth.counts[::SPARSE, ::SPARSE]
    known = sparse[sparse > 0]
    if not known.size:
        return encode_jpeg(Image(np.zeros((*depth.counts.shape, 3), np.uint8))), "nothing measured"
    near, far = np.percentile(known, (NEAR_PERCENT, FAR_PERCENT))
    shares = np.interp(depth.counts, (near, max(far, near + 1)), (255.0, 0.0)).astype(np.uint8)
    rgb = np.array(cv2.applyColorMap(shares, cv2.COLORMAP_TURBO)[:, :, ::-1], np.uint8)
    rgb[depth.counts == 0] = 0
    return encode_jpeg(Image(rgb)), f"{near * depth.unit_m:.2f} to {far * depth.unit_m:.2f} m"


class PageView:
    """What a page looks at. `now_s`: monotonic."""

    def __init__(self, now_s: float) -> None:
        self.streams: tuple[str, ...] = ()
        self.period_s = 0.1
        self.sent = self.drawn = 0
        self.limit = RateLimit(4 * MAX_PICTURE_HZ, 100.0, now_s)
        self._last: dict[str, tuple[int, float]] = {}

    def read(self, text: str, pictures: Pictures, now_s: float) -> str:
        """Obey a message of the page; why it was not obeyed, empty: it was."""
        try:
            request = parse(text)
            if not self.limit.take(now_s):
                return "too_fast"
            if isinstance(request, LookRequest):
                pictures.change(self.streams, request.streams)
                self.streams = tuple(dict.fromkeys(request.streams))
                self.period_s = 1 / min(max(request.hz, 0.1), MAX_PICTURE_HZ)
            elif isinstance(request, DrawnRequest):
                self.drawn = max(self.drawn, min(request.frame, self.sent))
        except CodecError:
            return "bad_message"
        return ""

    def due(self, now_s: float, pictures: Pictures) -> list[str]:
        """Streams of which a newer picture may be sent now."""
        found: list[str] = []
        for name in self.streams:
            room = self.sent + len(found) - self.drawn < IN_FLIGHT * len(self.streams)
            count, sent_s = self._last.get(name, (0, -1e9))
            newer = pictures.count(name)
            if room and newer != count and now_s - sent_s >= self.period_s:
                self._last[name] = (newer, now_s)
                found.append(name)
        return found
