"""What the camera node asks of a source of pictures that it has to wait for."""

from __future__ import annotations

import re
import threading
from typing import Any, Protocol

from numpy.typing import NDArray

Pixels = NDArray[Any]
"""What OpenCV gives: (H, W) or (H, W, 1, 3 or 4), blue first, uint8 or uint16."""

LOOK_S = 0.5
"""A picture is looked at this often even when nobody wants it: a broken camera is to be seen."""
STALL_S = 2.0
"""A source that gives no picture for this long is closed and opened again."""

_USER = re.compile(r"(?<=://)[^/]*@")
_SECRET = re.compile(r"(?i)(password|passwd|pass|pwd|token)=[^&/?]*")


class Source(Protocol):
    """A device, stream or file. Used by one thread; may be opened again after `close`."""

    @property
    def backend(self) -> str:
        """What reads it, known once it is open."""
        ...

    @property
    def same_s(self) -> float:
        """So long it may give the very same picture and work; 0: for ever. Known likewise."""
        ...

    @property
    def stamp_ns(self) -> int | None:
        """What the driver said of the time of the grabbed picture; None where it says nothing."""
        ...

    def open(self) -> None:
        """Get ready.

        Raises:
            NodeError: not there or not readable; says what to do.
        """
        ...

    def grab(self, stop: threading.Event) -> int | None:
        """Wait for the next picture without decoding more of it than must be.

        Returns:
            When it was captured, ns of the monotonic clock; None when there will be no more, or
            `stop` was set.

        Raises:
            NodeError: the source is gone.
        """
        ...

    def retrieve(self) -> Pixels | None:
        """The grabbed picture, None when it is broken."""
        ...

    def close(self) -> None:
        """Give the device back; harmless when it is not open."""
        ...


def without_password(url: str) -> str:
    """`url` without user and password, in front or among its parameters: fit for logs."""
    return _SECRET.sub(r"\1=***", _USER.sub("", url))
