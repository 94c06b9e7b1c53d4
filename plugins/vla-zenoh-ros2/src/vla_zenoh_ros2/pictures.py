"""Images and depth of ROS messages: all encodings of sensor_msgs/image_encodings that can be read.

Depth is told by its encoding and never becomes a picture. 16-bit colours are scaled to 8 bits.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import PNG_BEGINS, check_size, decode_jpeg, decode_png, decode_png16
from vla_zenoh.errors import CodecError

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
MILLIMETRE_M = 0.001
"""A count of 16-bit depth (REP 118)."""
_JPEG = b"\xff\xd8\xff"
_IS_DEPTH = "it holds distances: name its topic as ros2.cameras.NAME.depth"


class Encoding(NamedTuple):
    """Values of a pixel, and OpenCV's conversion to RGB; None: they are RGB."""

    type: str
    channels: int
    to_rgb: int | None


COLOURS = {
    "rgb8": Encoding("u1", 3, None),
    "bgr8": Encoding("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": Encoding("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": Encoding("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": Encoding("u1", 1, cv2.COLOR_GRAY2RGB),
    "8UC1": Encoding("u1", 1, cv2.COLOR_GRAY2RGB),
    "rgb16": Encoding("u2", 3, None),
    "bgr16": Encoding("u2", 3, cv2.COLOR_BGR2RGB),
    "rgba16": Encoding("u2", 4, cv2.COLOR_RGBA2RGB),
    "bgra16": Encoding("u2", 4, cv2.COLOR_BGRA2RGB),
    "yuv422": Encoding("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": Encoding("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": Encoding("u1", 2, cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": Encoding("u1", 2, cv2.COLOR_YUV2RGB_YUYV),
    "bayer_rggb8": Encoding("u1", 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": Encoding("u1", 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": Encoding("u1", 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": Encoding("u1", 1, cv2.COLOR_BayerGRBG2RGB),
    "bayer_rggb16": Encoding("u2", 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr16": Encoding("u2", 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg16": Encoding("u2", 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg16": Encoding("u2", 1, cv2.COLOR_BayerGRBG2RGB),
}
"""Encodings of colours and greys."""
DEPTHS = {
    "16UC1": Encoding("u2", 1, None),
    "mono16": Encoding("u2", 1, None),
    "32FC1": Encoding("f4", 1, None),
}
"""Encodings of distances: millimetres, or metres. Greys of 16 bits count as such."""
_IN_PAIRS = (cv2.COLOR_YUV2RGB_UYVY, cv2.COLOR_YUV2RGB_YUYV)


def read_rgb(message: Any) -> NDArray[np.uint8]:
    """(H, W, 3) of an Image; of ``rgb8`` a read-only view into the message."""
    name = message.encoding
    encoding = COLOURS.get(name)
    if encoding is None:
        known = f"read are: {', '.join(COLOURS)}"
        why = _IS_DEPTH if name in DEPTHS else known
        raise CodecError("encoding", f"an image of encoding {name[:40]!r}; {why}")
    rows = _rows(message, encoding)
    if encoding.type == "u2":
        rows = np.asarray(cv2.convertScaleAbs(rows, alpha=255 / 65535))
    if encoding.to_rgb is None:
        return rows
    if encoding.to_rgb in _IN_PAIRS and message.width % 2:
        raise CodecError("invalid", f"{name} of {message.width} pixels: they come in pairs")
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), encoding.to_rgb), np.uint8)
    except cv2.error as error:  # too small for a pattern of colours
        size = f"{message.height}x{message.width}"
        raise CodecError("invalid", f"{name} of {size} pixels: {error.err}") from error


def read_depth_m(message: Any) -> NDArray[np.float32]:
    """(H, W) metres of an Image, 0 or not finite where nothing was measured."""
    encoding = DEPTHS.get(message.encoding)
    if encoding is None:
        raise CodecError(
            "encoding",
            f"depth of encoding {message.encoding[:40]!r}; read are: {', '.join(DEPTHS)}",
        )
    return _metres(_rows(message, encoding)[..., 0])


def _rows(message: Any, encoding: Encoding) -> Any:
    """(H, W, channels) of an Image, in the byte order of this computer."""
    height, width, step = message.height, message.width, message.step
    check_size(height, width)
    kind = np.dtype(("<", ">")[bool(message.is_bigendian)] + encoding.type)
    row_bytes = width * encoding.channels * kind.itemsize
    if step < row_bytes:
        what = f"{width} pixels {message.encoding}"
        raise CodecError("invalid", f"rows of {step} bytes for {what}")
    data = np.asarray(message.data, np.uint8)
    # The last row may come without its padding.
    if len(data) < step * (height - 1) + row_bytes:
        raise CodecError("truncated", f"{len(data)} bytes of {step * height}")
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    if kind.itemsize == 1:
        return np.lib.stride_tricks.as_strided(
            data,
            (height, width, encoding.channels),
            (step, encoding.channels, 1),
            writeable=False,
        )
    values = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="))
    return values.reshape(height, width, encoding.channels)


# -- compressed -----------------------------------------------------------------------------------
_HEADER = struct.Struct("<iff")
"""In front of compressedDepth: its format, and the two numbers of quantised metres."""
_BITS_AT = 24
_GREY_16 = bytes((16, 0))


def read_compressed_rgb(message: Any) -> NDArray[np.uint8]:
    """(H, W, 3) of a CompressedImage: a JPEG or PNG, told apart by its bytes, since drivers write
    many things into ``format``."""
    payload = np.asarray(message.data, np.uint8).tobytes()
    if _is_compressed_depth(message) or _is_grey16(payload):
        raise CodecError("encoding", f"a compressed image {message.format[:40]!r}; {_IS_DEPTH}")
    if payload.startswith(_JPEG):
        return decode_jpeg(payload).rgb
    if payload.startswith(PNG_BEGINS):
        return decode_png(payload).rgb
    raise CodecError("encoding", f"a compressed image {message.format[:40]!r}; read are: jpeg, png")


def read_compressed_depth_m(message: Any) -> NDArray[np.float32]:
    """(H, W) metres of a CompressedImage: a 16-bit PNG, or one of compressed_depth_image_transport.

    Source: compressed_depth_image_transport, codec.cpp: quantised metres are A / (count - B).
    """
    payload = np.asarray(message.data, np.uint8).tobytes()
    quantised = None
    if _is_compressed_depth(message) and not payload.startswith(PNG_BEGINS):
        if len(payload) < _HEADER.size:
            raise CodecError("truncated", f"compressed depth of {len(payload)} bytes")
        _, a, b = _HEADER.unpack_from(payload)
        payload = payload[_HEADER.size :]
        if "32FC1" in message.format:
            quantised = a, b
    if not _is_grey16(payload):
        raise CodecError(
            "encoding",
            f"compressed depth {message.format[:40]!r}; read are PNG of 16 bits, also of "
            "compressed_depth_image_transport (compressedDepth, format png)",
        )
    counts = decode_png16(payload)
    if quantised is None:
        return _metres(counts)
    with np.errstate(all="ignore"):
        metres = quantised[0] / (counts.astype(np.float32) - quantised[1])
    return np.where(counts == 0, 0, metres).astype(np.float32)


def _metres(values: Any) -> NDArray[np.float32]:
    scale = MILLIMETRE_M if values.dtype == np.uint16 else 1.0
    return values.astype(np.float32) * np.float32(scale)


def _is_compressed_depth(message: Any) -> bool:
    return "compressedDepth" in message.format


def _is_grey16(payload: bytes) -> bool:
    return payload.startswith(PNG_BEGINS) and payload[_BITS_AT : _BITS_AT + 2] == _GREY_16
