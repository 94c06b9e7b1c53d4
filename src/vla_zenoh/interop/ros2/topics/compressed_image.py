"""sensor_msgs/CompressedImage: JPEG and PNG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import MAX_JPEG_BYTES, MAX_PIXELS, MAX_SIDE, decode_jpeg
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.ros2.samples import RosImage
from vla_zenoh.interop.ros2.stamps import to_ns

TYPE = "sensor_msgs/msg/CompressedImage"
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"


def read(message: Any) -> RosImage:
    """The picture. What it is, is seen in its bytes: drivers write many things into ``format``.

    Raises:
        CodecError: ``encoding``, or it cannot be decoded.
    """
    payload = np.asarray(message.data, np.uint8).tobytes()
    if "compressedDepth" in message.format or not payload.startswith((_PNG, _JPEG)):
        raise CodecError(
            "encoding", f"a compressed image {message.format[:40]!r}; read are: jpeg, png"
        )
    rgb = decode_jpeg(payload).rgb if payload.startswith(_JPEG) else _png(payload)
    return RosImage(to_ns(message.header.stamp), message.header.frame_id, rgb)


def _png(payload: bytes) -> NDArray[np.uint8]:
    if len(payload) > MAX_JPEG_BYTES:
        raise CodecError("oversize", f"a PNG of {len(payload)} bytes, at most {MAX_JPEG_BYTES}")
    width, height = (int.from_bytes(payload[at : at + 4], "big") for at in (16, 20))
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and height * width <= MAX_PIXELS):
        raise CodecError("invalid", f"an image of {height}x{width}")
    try:
        bgr = cv2.imdecode(np.frombuffer(payload, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise CodecError("malformed", f"not a PNG file: {error.err}") from error
    if bgr is None:
        raise CodecError("malformed", "not a PNG file that can be decoded")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr), np.uint8)
