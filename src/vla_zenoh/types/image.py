"""A picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.checks import set_field


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """A picture: RGB, uint8, ``(height, width, 3)``, row by row from the top left."""

    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        rgb = self.rgb
        if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8:
            raise RecordError("an image must be a uint8 array (H, W, 3) in RGB order")
        if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
            raise RecordError(f"an image has shape {rgb.shape}, wanted (H, W, 3)")
        rgb = np.ascontiguousarray(rgb).view()  # the maker's own array stays as writable as it was
        rgb.setflags(write=False)
        set_field(self, "rgb", rgb)
