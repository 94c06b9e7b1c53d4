"""A sample image with the frames of arm, camera and board drawn over it."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.hand_eye import HandEye
from vla_zenoh_calibrate.lens import distortion_of
from vla_zenoh_calibrate.view import inverse

AXES = ((230, 60, 50), (60, 190, 70), (60, 110, 240))
"""Red, green and blue of x, y and z, RGB."""
LENGTH_M, NEAR_M = 0.05, 0.02


def with_frames(
    image: NDArray[np.uint8], lens: Intrinsics, frames: Mapping[str, FloatArray]
) -> NDArray[np.uint8]:
    """A copy of an image (H, W, 3) RGB with axes of 5 cm.

    Args:
        frames: name -> pose (4, 4) in the camera; those behind it or beside the image are left out.
    """
    drawn = image.copy()
    width = max(1, round(lens.width / 400))
    for name, pose in frames.items():
        ends = np.vstack([pose[:3, 3], (pose[:3, 3] + LENGTH_M * pose[:3, :3].T)])
        if (ends[:, 2] < NEAR_M).any():
            continue
        pixels, _ = cv2.projectPoints(
            ends, np.zeros(3), np.zeros(3), lens.matrix, distortion_of(lens)
        )
        pixels = np.asarray(pixels).reshape(-1, 2)
        if (np.abs(pixels) > 4 * max(lens.width, lens.height)).any():
            continue
        origin, *tips = [tuple(int(value) for value in point.round()) for point in pixels]
        for tip, colour in zip(tips, AXES, strict=True):
            cv2.line(drawn, origin, tip, colour, width + 1, cv2.LINE_AA)
        at = origin[0] + 4 * width, origin[1] - 4 * width
        scale = 0.0009 * lens.width
        for colour, thick in (((0, 0, 0), width + 2), ((255, 255, 255), width)):
            cv2.putText(
                drawn, name, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thick, cv2.LINE_AA
            )
    return drawn


def arm_frames(place: HandEye, arm: FloatArray) -> dict[str, FloatArray]:
    """Base and TCP in the camera, and the board where the arm's pose (4, 4) puts it."""
    eye = inverse(place.camera)
    if place.eye == "in-hand":
        base = eye @ inverse(arm)
        return {"base": base, "tcp": eye, "board": base @ place.board}
    return {"base": eye, "tcp": eye @ arm, "board": eye @ arm @ place.board}
