"""Images: raw pixels with their size in the encoding, plain JPEG files, and depth as plain 16-bit
PNG files.

Raw frames have no prefix: the shape travels in the sample's encoding schema
(``zenoh/bytes;rgb8;480x640``), so that the payload is just the pixels. That of a depth image gives
the metres of a count (``image/png;depth16;0.001``: 1 mm).

JPEG files need no OpenCV, PNG files do.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.policy.resize import HAS_OPENCV
from vla_zenoh.types import Depth, Image, shown

MAX_SIDE = 8192
MAX_PIXELS = 8192 * 4096
"""A few forged bytes of JPEG can ask for this many pixels; three bytes of memory each."""
MAX_JPEG_BYTES = 32 * 1024 * 1024
MAX_SCANS = 100
"""Progressive files have about ten, of a few bytes each, and each is a pass over all pixels."""
MAX_IMAGE_BYTES = 3 * MAX_PIXELS
"""Of an image in any form."""
DEFAULT_JPEG_QUALITY = 90
MAX_PNG_BYTES = 64 * 1024 * 1024

PNG_BEGINS, PNG_ENDS = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_GREY_16 = bytes((16, 0, 0, 0, 0))
"""Bits, colour type, compression, filter and interlace of a PNG's first chunk."""
_DEPTH_SCHEMA = re.compile(r"depth16;([0-9]{1,3}(?:\.[0-9]{1,12})?(?:e-?[0-9]{1,2})?)")

_RAW_SCHEMA = re.compile(r"rgb8;([0-9]{1,5})x([0-9]{1,5})")
# JPEG markers: frame headers carry the size; some others have no length field behind them.
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset({0x00, 0x01}) | frozenset(range(0xD0, 0xDA))


def raw_schema(image: Image) -> str:
    """The encoding's schema for this image: ``rgb8;HEIGHTxWIDTH``."""
    height, width, _ = image.rgb.shape
    return f"rgb8;{height}x{width}"


def encode_raw(image: Image) -> bytes:
    """The pixels, row by row."""
    return image.rgb.tobytes()


def decode_raw(payload: bytes, schema: str) -> Image:
    """An image from its pixels, without copying; `CodecError`: schema or length do not fit."""
    match = _RAW_SCHEMA.fullmatch(schema)
    if match is None:
        raise CodecError("malformed", f"raw image schema {shown(schema)}, wanted rgb8;HEIGHTxWIDTH")
    height, width = int(match[1]), int(match[2])
    check_size(height, width)
    if len(payload) != height * width * 3:
        raise CodecError("truncated", f"{len(payload)} bytes for an rgb8 image of {height}x{width}")
    return Image(np.frombuffer(payload, np.uint8).reshape(height, width, 3))


def encode_jpeg(image: Image, quality: int = DEFAULT_JPEG_QUALITY) -> bytes:
    """A JPEG file; `CodecError`: the image is larger than `decode_jpeg` reads."""
    height, width, _ = image.rgb.shape
    check_size(height, width)
    if not HAS_OPENCV:
        # Less accurate below a quality of 96, by 0.2 dB at the default.
        return simplejpeg.encode_jpeg(np.ascontiguousarray(image.rgb), quality, "RGB", "420", False)
    from vla_zenoh.opencv import cv2

    bgr = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise CodecError("unencodable", f"no JPEG could be made of a {image.rgb.shape} image")
    return data.tobytes()


def decode_jpeg(payload: bytes) -> Image:
    """A JPEG file to RGB pixels, turned as they are stored whatever its EXIF says.

    Raises:
        CodecError: not a whole one, or larger than we read.
    """
    if len(payload) > MAX_JPEG_BYTES:
        raise CodecError("oversize", f"a JPEG of {len(payload)} bytes, at most {MAX_JPEG_BYTES}")
    if payload[:3] != b"\xff\xd8\xff":
        raise CodecError("malformed", "not a JPEG file")
    if payload.rstrip(b"\0")[-2:] != b"\xff\xd9":
        raise CodecError("truncated", "a JPEG file without its end")
    check_size(*_jpeg_size(payload))
    scans = payload.count(b"\xff\xda")
    if scans > MAX_SCANS:
        raise CodecError("invalid", f"a JPEG file of {scans} scans, at most {MAX_SCANS}")
    try:
        # As OpenCV decodes: exact, and the rest of a file whose middle is damaged.
        rgb = simplejpeg.decode_jpeg(payload, "RGB", False, False, strict=False)
    except ValueError as error:
        why = f"not a JPEG file that can be decoded: {error}"
        raise CodecError("malformed", why) from error
    return Image(rgb)


def decode_png(payload: bytes) -> Image:
    """A PNG file of others to RGB pixels; `CodecError`: not one, or larger than we read."""
    from vla_zenoh.opencv import cv2

    if len(payload) > MAX_JPEG_BYTES:
        raise CodecError("oversize", f"a PNG of {len(payload)} bytes, at most {MAX_JPEG_BYTES}")
    if len(payload) < 24 or not payload.startswith(PNG_BEGINS):
        raise CodecError("malformed", "not a PNG file")
    _checked_png_size(payload)
    bgr = _pixels(_pixels_of_png(payload), cv2.IMREAD_COLOR)
    if bgr is None:
        raise CodecError("malformed", "not a PNG file that can be decoded")
    # In place: a large image is not held twice.
    return Image(np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr), np.uint8))


def _pixels_of_png(payload: bytes) -> bytes:
    """A PNG file without its ancillary chunks: texts and colour profiles may unpack to gigabytes,
    and animations hold further images."""
    kept, at = [PNG_BEGINS], len(PNG_BEGINS)
    while at < len(payload):
        end = at + 12 + int.from_bytes(payload[at : at + 4], "big")
        if end > len(payload):
            raise CodecError("malformed", "not a PNG file that can be decoded: a chunk is cut off")
        if payload[at + 4 : at + 8] in _PIXEL_CHUNKS:
            kept.append(payload[at:end])
        at = end
    return b"".join(kept)


def _checked_png_size(payload: bytes) -> tuple[int, int]:
    """Height and width, read before any memory is taken for pixels."""
    width, height = (int.from_bytes(payload[at : at + 4], "big") for at in (16, 20))
    check_size(height, width)
    return height, width


def _pixels(png: bytes, flags: int) -> Any:
    from vla_zenoh.opencv import cv2

    try:
        return cv2.imdecode(np.frombuffer(png, np.uint8), flags)
    except cv2.error as error:
        raise CodecError("malformed", f"not a PNG file: {error.err}") from error


def depth_schema(depth: Depth) -> str:
    """The encoding's schema for this depth image: ``depth16;METRES``."""
    return f"depth16;{depth.unit_m:.9g}"


def encode_depth(depth: Depth) -> bytes:
    """A PNG file of 16 bits; `CodecError`: the image is larger than `decode_depth` reads."""
    from vla_zenoh.opencv import cv2

    check_size(*depth.counts.shape)
    # For noisy camera images: the fastest setting, and the smallest file.
    way = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    ok, data = cv2.imencode(".png", depth.counts, way)
    if not ok:
        raise CodecError("unencodable", f"no PNG could be made of {depth.counts.shape} depths")
    return data.tobytes()


def decode_depth(payload: bytes, schema: str) -> Depth:
    """A depth image from a PNG file of 16 bits.

    Raises:
        CodecError: the schema lacks the unit; not a whole PNG file of one channel of 16 bits, or
            larger than we read.
    """
    match = _DEPTH_SCHEMA.fullmatch(schema)
    if match is None:
        why = f"depth schema {shown(schema)}, wanted depth16;METRES_A_COUNT"
        raise CodecError("malformed", why)
    try:
        return Depth(decode_png16(payload), float(match[1]))
    except RecordError as error:
        raise CodecError("invalid", f"depth schema: {error}") from error


def decode_png16(payload: bytes) -> NDArray[np.uint16]:
    """(H, W) of a PNG file of one channel of 16 bits; `CodecError`: not a whole one, or larger
    than we read."""
    from vla_zenoh.opencv import cv2

    if len(payload) > MAX_PNG_BYTES:
        raise CodecError("oversize", f"a PNG of {len(payload)} bytes, at most {MAX_PNG_BYTES}")
    if payload[:8] != PNG_BEGINS or payload[12:16] != b"IHDR":
        raise CodecError("malformed", "not a PNG file")
    if payload[-8:] != PNG_ENDS:
        raise CodecError("truncated", "a PNG file without its end")
    size = _checked_png_size(payload)
    if payload[24:29] != _GREY_16:
        raise CodecError("invalid", "a depth image is a PNG file of one channel of 16 bits")
    counts = _pixels(_pixels_of_png(payload), cv2.IMREAD_UNCHANGED)
    if counts is None or counts.shape != size or counts.dtype != np.uint16:
        raise CodecError("malformed", "not a PNG file that can be decoded as depth")
    return np.asarray(counts, np.uint16)


def check_size(height: int, width: int) -> None:
    """Raise a `CodecError` for an image without pixels, or with too many to be decoded."""
    sides_fit = 1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE
    if not sides_fit or height * width > MAX_PIXELS:
        raise CodecError(
            "invalid",
            f"an image of {height}x{width}: sides are 1 to {MAX_SIDE}, pixels at most {MAX_PIXELS}",
        )


def _jpeg_size(payload: bytes) -> tuple[int, int]:
    """Height and width from the frame header, read before any memory is taken for pixels.

    Stricter than decoders are: where they skip data that this walk reads in another way, a second
    frame header could hide.
    """
    at = 2
    while at + 9 <= len(payload):
        if payload[at] != 0xFF:
            break
        marker = payload[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _WITHOUT_LENGTH:
            break
        if marker in _FRAME_HEADERS:
            return (
                int.from_bytes(payload[at + 5 : at + 7], "big"),
                int.from_bytes(payload[at + 7 : at + 9], "big"),
            )
        length = int.from_bytes(payload[at + 2 : at + 4], "big")
        if length < 2:
            break
        at += 2 + length
    raise CodecError("malformed", "a JPEG file without a frame header")
