"""Images of R2C: JPEG files, whose colours a robot may have exchanged."""

from __future__ import annotations

import numpy as np

from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.types import Image
from vla_zenoh_r2c.declared import Camera


def read_image(camera: Camera, file: bytes) -> Image:
    """The pixels of a file.

    Raises:
        CodecError: it is no JPEG file, or too large.
    """
    return _exchanged(camera, decode_jpeg(file))


def write_image(camera: Camera, image: Image) -> bytes:
    """A JPEG file, as the camera's own are."""
    return encode_jpeg(_exchanged(camera, image))


def _exchanged(camera: Camera, image: Image) -> Image:
    if camera.colours == "rgb":
        return image
    return Image(np.ascontiguousarray(image.rgb[..., ::-1]))
