"""sensor_msgs/Image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import MAX_PIXELS, MAX_SIDE
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2.samples import RosImage
from vla_zenoh.interop.ros2.stamps import to_ns

TYPE = "sensor_msgs/msg/Image"
CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def read(message: Any) -> RosImage:
    """The picture; of ``rgb8`` a view into the message.

    Raises:
        CodecError: ``encoding`` (none of `CHANNELS`), ``invalid`` (a size that cannot be) or
            ``truncated``.
    """
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        deep = message.encoding in ("16UC1", "32FC1", "mono16")
        raise CodecError(
            "encoding",
            f"an image of encoding {message.encoding[:40]!r}; read are: {', '.join(CHANNELS)}"
            + (". This one holds distances, which no model here takes" if deep else ""),
        )
    height, width, step = message.height, message.width, message.step
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        raise CodecError("invalid", f"an image of {height}x{width}")
    if step < width * channels:
        raise CodecError("invalid", f"rows of {step} bytes for {width} pixels {message.encoding}")
    data = np.asarray(message.data, np.uint8)
    # The last row may come without its padding.
    if len(data) < step * (height - 1) + width * channels:
        raise CodecError("truncated", f"{len(data)} bytes of {step * height}")
    rows = np.lib.stride_tricks.as_strided(
        data, (height, width, channels), (step, channels, 1), writeable=False
    )
    rgb = rows if message.encoding == "rgb8" else _to_rgb(rows, message.encoding)
    return RosImage(to_ns(message.header.stamp), message.header.frame_id, rgb)


def _to_rgb(rows: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    code = cv2.COLOR_BGR2RGB if encoding == "bgr8" else cv2.COLOR_GRAY2RGB
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), code), np.uint8)
