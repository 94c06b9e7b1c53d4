"""Pictures for pages: newest JPEG of each stream that some page looks at."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import zenoh

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.newest_records import StreamSlot

MAX_PICTURE_BYTES = 4 * 1024 * 1024
MAX_STREAMS = 32
"""Of all pages together."""
JPEG_START = b"\xff\xd8"


class Picture(NamedTuple):
    """A picture.

    Args:
        jpeg: the file.
        stamp_wall_ns: capture, clock of its camera.
    """

    jpeg: bytes
    stamp_wall_ns: int


class _Stream:
    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.latest = StreamSlot(MAX_PICTURE_BYTES)
        self.subscriber: Any = self.latest.subscribe(session, key)
        self.users = 0


class Pictures:
    """Subscriptions to pictures, each while at least one page wants it: cameras and workers publish
    them because of these. Safe to use from several threads.

    Args:
        session: open.
        keys: of the robot.
        cameras: names in the profile.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, cameras: Iterable[str]) -> None:
        self._session, self._keys = session, keys
        self.cameras = tuple(cameras)
        self._streams: dict[str, _Stream] = {}
        self._lock = threading.Lock()
        self.rejected: Counter[str] = Counter()

    def _key(self, name: str) -> str:
        """Key of ``camera/NAME`` or ``seen/WORKER/CAMERA``.

        Raises:
            CodecError: there is no such stream.
        """
        kind, _, rest = name.partition("/")
        try:
            if kind == "camera" and rest in self.cameras:
                return self._keys.camera_jpeg(rest)
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
                    self._streams[name] = _Stream(self._session, key)
                self._streams[name].users += 1
            gone = [self._dropped(name) for name in before - wanted]
        for stream in gone:
            if stream is not None:
                stream.subscriber.undeclare()

    def _dropped(self, name: str) -> _Stream | None:
        stream = self._streams[name]
        stream.users -= 1
        return self._streams.pop(name) if stream.users == 0 else None

    def count(self, name: str) -> int:
        """Pictures that came so far."""
        stream = self._streams.get(name)
        return 0 if stream is None else stream.latest.count

    def newest(self, name: str) -> Picture | None:
        """The newest picture of a stream; None before the first, or if it is no JPEG file."""
        stream = self._streams.get(name)
        sample = None if stream is None else stream.latest.arrival
        if sample is None:
            return None
        try:
            jpeg = bytes_of(sample.sample.payload, MAX_PICTURE_BYTES)
            if not jpeg.startswith(JPEG_START):
                raise CodecError("malformed", "no JPEG file")
            return Picture(jpeg, header_of(sample.sample).stamp_wall_ns)
        except CodecError as error:
            self.rejected[error.reason] += 1
            return None
