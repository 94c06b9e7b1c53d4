"""Undistortion, crop and flip of a camera's images, and the intrinsics of what comes out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from vla_zenoh.errors import NodeError, describe_faults
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.profile.section import Section

Pixels = NDArray[Any]
"""An image as OpenCV returns it: (H, W) or (H, W, 1, 3 or 4), BGR, uint8 or uint16."""
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
MAX_FILE_BYTES = 100_000


class Intrinsics(Section):
    """Pinhole model of a camera, as in the file that ``cameras.NAME.intrinsics`` names.

    Args:
        width, height: of the calibration images, pixels.
        fx_px, fy_px: focal lengths.
        cx_px, cy_px: principal point; (0, 0) is the outer corner of the first pixel.
        distortion: k1, k2, p1, p2, k3 of OpenCV; empty: none.
    """

    width: int = Field(ge=16, le=8192)
    height: int = Field(ge=16, le=8192)
    fx_px: float = Field(gt=0)
    fy_px: float = Field(gt=0)
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = Field(default=(), max_length=5, strict=False)

    def scaled(self, width: int, height: int) -> Intrinsics:
        """The same lens with images of another size."""
        across, down = width / self.width, height / self.height
        return self.model_copy(
            update={
                "width": width,
                "height": height,
                "fx_px": self.fx_px * across,
                "fy_px": self.fy_px * down,
                "cx_px": self.cx_px * across,
                "cy_px": self.cy_px * down,
            }
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) camera matrix of OpenCV, whose origin is the centre of the first pixel."""
        cx, cy = self.cx_px - 0.5, self.cy_px - 0.5
        return np.array([[self.fx_px, 0.0, cx], [0.0, self.fy_px, cy], [0.0, 0.0, 1.0]])

    def shown(self) -> dict[str, float]:
        """For the camera's status."""
        names = ("fx_px", "fy_px", "cx_px", "cy_px")
        named = {name: round(getattr(self, name), 4) for name in names}
        return named | dict(zip(DISTORTION, self.distortion, strict=False))


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics in a YAML file, or a `NodeError` that says what is wrong there."""
    try:
        with path.open("rb") as file:
            data = yaml.safe_load(file.read(MAX_FILE_BYTES))
        return Intrinsics.model_validate(data)
    except OSError as error:
        raise NodeError(f"intrinsics {path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise NodeError(f"intrinsics {path}: {describe_faults(error, 'it')}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise NodeError(f"intrinsics {path} is not YAML: {error}") from error


class Geometry:
    """Processing of a camera's images before publication: undistortion in the camera's own size,
    crop, flip, then resizing to the profile's size. `intrinsics` are of the camera's own images.

    Raises:
        NodeError: the profile's file of intrinsics is wrong, or missing for an undistortion.
    """

    def __init__(self, profile: CameraProfile, intrinsics: Intrinsics | None = None) -> None:
        self._profile = profile
        if profile.intrinsics is not None:
            intrinsics = read_intrinsics(Path(profile.intrinsics))
        if profile.undistort and intrinsics is None:
            raise NodeError("undistort needs intrinsics: name a file with them")
        self._own = intrinsics
        self._size: tuple[int, int] | None = None
        self._maps: dict[tuple[int, int], tuple[Pixels, Pixels]] = {}

    def apply(self, image: Pixels, *, depth: bool = False) -> Pixels:
        """The image as it is published; with `depth`, pixels are never averaged.

        Raises:
            NodeError: the crop reaches beyond the image.
        """
        from vla_zenoh.opencv import cv2

        height, width = image.shape[:2]
        profile, crop = self._profile, self._profile.crop
        self._size = (width, height)
        if profile.undistort and self._own is not None and self._own.distortion:
            method = cv2.INTER_NEAREST if depth else cv2.INTER_LINEAR
            image = cv2.remap(image, *self._undistortion(width, height), method)
        if crop is not None:
            if crop.left + crop.width > width or crop.top + crop.height > height:
                raise NodeError(
                    f"the crop of {crop.width}x{crop.height} at {crop.left}, {crop.top} reaches "
                    f"beyond the camera's image of {width}x{height}"
                )
            image = image[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
        if profile.flip != "none":
            image = cv2.flip(image, _FLIPS[profile.flip])
        return resize(image, profile.width, profile.height, depth=depth)

    def intrinsics(self) -> Intrinsics | None:
        """Intrinsics of the images that `apply` returns; None: unknown."""
        if self._own is None:
            return None
        profile, seen = self._profile, self._own
        if self._size is not None:  # the camera's size, which may differ from the file's
            seen = seen.scaled(*self._size)
        change: dict[str, Any] = {"distortion": ()} if profile.undistort else {}
        if (crop := profile.crop) is not None:
            change |= {"width": crop.width, "height": crop.height}
            change |= {"cx_px": seen.cx_px - crop.left, "cy_px": seen.cy_px - crop.top}
        seen = seen.model_copy(update=change)
        change, lens = {}, list(seen.distortion)
        # Mirroring reverses the sign of the tangential distortion.
        if profile.flip in ("horizontal", "both"):
            change["cx_px"] = seen.width - seen.cx_px
            lens[3:4] = [-value for value in lens[3:4]]
        if profile.flip in ("vertical", "both"):
            change["cy_px"] = seen.height - seen.cy_px
            lens[2:3] = [-value for value in lens[2:3]]
        seen = seen.model_copy(update={**change, "distortion": tuple(lens)})
        return seen.scaled(profile.width, profile.height)

    def _undistortion(self, width: int, height: int) -> tuple[Pixels, Pixels]:
        if (width, height) not in self._maps:
            from vla_zenoh.opencv import cv2

            assert self._own is not None
            lens = self._own.scaled(width, height)
            coefficients = np.array([*lens.distortion, *[0.0] * (5 - len(lens.distortion))])
            self._maps[width, height] = cv2.initUndistortRectifyMap(
                lens.matrix, coefficients, np.eye(3), lens.matrix, (width, height), cv2.CV_32FC1
            )
        return self._maps[width, height]


_FLIPS = {"horizontal": 1, "vertical": 0, "both": -1}


def resize(image: Pixels, width: int, height: int, *, depth: bool = False) -> Pixels:
    """Stretch to (height, width): by area averaging to shrink, linearly to enlarge, and depth by
    its nearest pixel."""
    from vla_zenoh.opencv import cv2

    had_height, had_width = image.shape[:2]
    if (had_height, had_width) == (height, width):
        return image
    if depth:
        method = cv2.INTER_NEAREST_EXACT
    else:
        method = cv2.INTER_AREA if width * height < had_width * had_height else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)
