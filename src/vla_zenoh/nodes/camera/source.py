"""Interface of the image sources that the camera node waits for."""

from __future__ import annotations

import re
import threading
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

Pixels = NDArray[Any]
"""An image as OpenCV returns it: (H, W) or (H, W, 1, 3 or 4), BGR, uint8 or uint16."""

LOOK_S = 0.5
"""Without subscribers one image in this time is still decoded, to detect a broken camera."""
STALL_S = 2.0
"""A source that delivers no image for this long is closed and opened again."""
_USER = re.compile(r"(?<=://)[^/]*@")
_SECRET = re.compile(r"(?i)(password|passwd|pass|pwd|token)=[^&/?]*")


class Source(Protocol):
    """A device, stream or file. Used by one thread; may be opened again after `close`."""

    @property
    def backend(self) -> str:
        """Name of the library or driver that reads it; known once it is open."""
        ...

    @property
    def same_s(self) -> float:
        """How long a working source may repeat an identical image, s; 0: indefinitely."""
        ...

    @property
    def stamp_ns(self) -> int | None:
        """Driver's time stamp of the grabbed image, on any clock; None if there is none."""
        ...

    def open(self) -> None:
        """Open the source.

        Raises:
            NodeError: missing or not readable; says what to do.
        """
        ...

    def grab(self, stop: threading.Event) -> int | None:
        """Wait for the next image, decoding as little of it as possible.

        Returns:
            Time of capture, ns of the monotonic clock; None if the source has ended or `stop` was
            set.

        Raises:
            NodeError: the source is gone.
        """
        ...

    def retrieve(self) -> Pixels | None:
        """Decode the grabbed image; None if it is corrupt."""
        ...

    def close(self) -> None:
        """Release the device; harmless if it is not open."""
        ...


@runtime_checkable
class DepthSource(Protocol):
    """A `Source` that measures depth as well, and knows its lens."""

    def depth_m(self) -> NDArray[Any] | None:
        """Depth of the grabbed image in m, in its pixels; 0: not measured. None: it has none."""
        ...


def without_password(url: str) -> str:
    """`url` without its user, password and token parameters, for logs."""
    return _SECRET.sub(r"\1=***", _USER.sub("", url))
