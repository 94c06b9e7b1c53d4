"""Any picture OpenCV gives to RGB of the size that is promised."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.source import Pixels

_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}


def fit(picture: Pixels, width: int, height: int) -> Pixels:
    """Stretch to (height, width): averaging when it shrinks, linear when it grows."""
    had_height, had_width = picture.shape[:2]
    if (had_height, had_width) == (height, width):
        return picture
    shrinks = width * height < had_width * had_height
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(picture, (width, height), interpolation=method)


def to_rgb(picture: Pixels) -> NDArray[np.uint8]:
    """Grey, BGR or BGRA of 8 or 16 bits to RGB uint8 (H, W, 3).

    Raises:
        NodeError: it is none of these.
    """
    channels = 1 if picture.ndim == 2 else picture.shape[2] if picture.ndim == 3 else 0
    if channels not in _TO_RGB or picture.dtype not in (np.uint8, np.uint16):
        raise NodeError(
            f"a picture of shape {picture.shape} and type {picture.dtype} cannot be shown; "
            "wanted 1, 3 or 4 channels of 8 or 16 bits"
        )
    if picture.dtype == np.uint16:
        picture = (picture >> 8).astype(np.uint8)
    return np.asarray(cv2.cvtColor(picture, _TO_RGB[channels]), np.uint8)
