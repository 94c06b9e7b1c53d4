"""H.264 in MP4, written picture by picture."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.errors import CodecError, MissingExtraError, RecordingError
from vla_zenoh.policy.resize import scaled

CODEC, PIXEL_FORMAT = "libx264", "yuv420p"


def at_height(rgb: NDArray[np.uint8], height_px: int) -> NDArray[np.uint8]:
    """A picture in another height, not distorted."""
    return scaled(rgb, max(1, round(rgb.shape[1] * height_px / rgb.shape[0])), height_px)


def decoded_at_height(jpeg: bytes, height_px: int) -> NDArray[np.uint8]:
    """A JPEG file in this height; a black square if it is none."""
    try:
        return at_height(decode_jpeg(jpeg).rgb, height_px)
    except CodecError:
        return np.zeros((height_px, height_px, 3), np.uint8)


class VideoWriter:
    """Writes images of one size at a constant rate into an MP4 file.

    Args:
        path: of the file; its folder is made.
        options: of the encoder, such as ``crf``, the constant rate factor.
    """

    def __init__(self, path: Path, rate_hz: int, **options: str) -> None:
        try:
            import av
        except ImportError as error:
            raise MissingExtraError("av", "sim") from error
        path.parent.mkdir(parents=True, exist_ok=True)
        self._av, self._rate_hz = av, rate_hz
        self._options = {"preset": "veryfast", **options}
        self._container: Any = av.open(str(path), "w")
        self._stream: Any = None
        self.size = (0, 0)
        """Height and width: even, as the codec requires; an odd last row or column is cut off."""

    def add(self, rgb: NDArray[np.uint8], count: int = 1) -> NDArray[np.uint8]:
        """Append an image as `count` frames; returns it as cut to `size`.

        Raises:
            RecordingError: its size differs from that of the first image.
        """
        size = (rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2)
        if self._stream is None:
            self.size = size
            self._stream = self._container.add_stream(CODEC, rate=Fraction(self._rate_hz))
            self._stream.height, self._stream.width = size
            self._stream.pix_fmt = PIXEL_FORMAT
            self._stream.options = self._options
        if size != self.size:
            raise RecordingError(f"images of {self.size} and of {size} pixels in one video")
        cut = np.ascontiguousarray(rgb[: size[0], : size[1]])
        for _ in range(count):
            frame = self._av.VideoFrame.from_ndarray(cut, format="rgb24")
            self._container.mux(self._stream.encode(frame))
        return cut

    def close(self) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()
