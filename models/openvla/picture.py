"""From a camera's image to the one OpenVLA was trained on.

The data went through JPEG and a Lanczos resize to a square, without keeping the aspect ratio; a
model that was trained with random crops gets the middle of the image. Any difference from that
costs success (the crop alone about 3 points of 100 on LIBERO), so all of it is done here and
nothing is left to the camera.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 224
"""Pixels of the square that the data was resized to."""
JPEG_QUALITY = 95
CROP_AREA = 0.9
LANCZOS_LOBES = 3

Picture = NDArray[np.uint8]


def trained_form(rgb: Picture, *, crop: bool, side: int = SIDE) -> Picture:
    """An image in the form of the training data.

    Args:
        rgb: (H, W, 3) as the camera gave it.
        crop: the model was trained with random crops: the middle 90 % of the area.
        side: of the square.

    Returns:
        (side, side, 3) uint8 RGB.
    """
    square = lanczos(through_jpeg(rgb), side)
    return centre_crop(square) if crop else square


def through_jpeg(rgb: Picture) -> Picture:
    """The image after JPEG compression."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    back = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert back is not None
    return np.asarray(cv2.cvtColor(back, cv2.COLOR_BGR2RGB), np.uint8)


def lanczos(rgb: Picture, side: int) -> Picture:
    """Resize to a square with Lanczos' kernel of three lobes, widened when it makes smaller."""
    height, width, colours = rgb.shape
    rows, columns = _lanczos_weights(height, side), _lanczos_weights(width, side)
    # Two plain products of matrices are several times faster than sums over axes.
    tall = rows @ rgb.reshape(height, -1).astype(np.float32)
    across = tall.reshape(side, width, colours).transpose(0, 2, 1).reshape(-1, width)
    scaled = (across @ columns.T).reshape(side, colours, side).transpose(0, 2, 1)
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


@lru_cache(maxsize=16)
def _lanczos_weights(size: int, side: int) -> NDArray[np.float32]:
    """(side, size) weights of the old pixels in each new one; every row sums to one."""
    factor = size / side
    widen = max(factor, 1.0)
    centres = (np.arange(side) + 0.5) * factor
    away = (np.arange(size)[None] + 0.5 - centres[:, None]) / widen
    kernel = np.sinc(away) * np.sinc(away / LANCZOS_LOBES)
    kernel[np.abs(away) >= LANCZOS_LOBES] = 0.0
    return (kernel / kernel.sum(axis=1, keepdims=True)).astype(np.float32)


def centre_crop(rgb: Picture) -> Picture:
    """The middle `CROP_AREA` of the area, bilinearly back to the old size."""
    side = rgb.shape[0]
    part = math.sqrt(CROP_AREA)
    at = ((1 - part) / 2 + np.arange(side) / (side - 1) * part) * (side - 1)
    first = np.floor(at).astype(int)
    second = np.minimum(first + 1, side - 1)
    share = (at - first).astype(np.float32)
    pixels = rgb.astype(np.float32)
    rows = pixels[first] * (1 - share)[:, None, None] + pixels[second] * share[:, None, None]
    both = rows[:, first] * (1 - share)[None, :, None] + rows[:, second] * share[None, :, None]
    # The training code goes from [0, 1] to bytes with 255.5 and cuts off.
    return np.clip(both / 255 * 255.5, 0, 255).astype(np.uint8)
