"""OpenCV, or an error that names the extra which brings it: ``from vla_zenoh.opencv import cv2``.

Only what draws, records videos or reads cameras and PNG files has it; JPEG files and images of
another size do without.
"""

from __future__ import annotations

from vla_zenoh.errors import MissingExtraError

try:
    import cv2
except ModuleNotFoundError as error:
    raise MissingExtraError("cv2", "camera") from error

__all__ = ["cv2"]
