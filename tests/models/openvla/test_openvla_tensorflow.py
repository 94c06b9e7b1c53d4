"""The picture's way against TensorFlow, with which the training data were made.

TensorFlow is large and needed for nothing else, so these tests run only when it is asked for:
``scripts/test_models.py openvla --with tensorflow-cpu -- -k tensorflow``.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

tf = pytest.importorskip("tensorflow", reason="for --with tensorflow-cpu")
from vla_zenoh_model_openvla.picture import (  # noqa: E402
    JPEG_QUALITY,
    Picture,
    centre_crop,
    lanczos,
)

pytestmark = pytest.mark.models

ROUNDED = 1
"""Grey levels."""
ROUNDED_SHARE = 1e-3
DECODED = 2.5
"""Mean of grey levels: TensorFlow decodes JPEG by a coarser cosine transform, OpenCV does not."""


def pictures() -> list[Picture]:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    mosaic = noise[:12, :16].repeat(40, axis=0).repeat(40, axis=1)
    soft = np.asarray(cv2.GaussianBlur(mosaic, (0, 0), 9), np.uint8)
    return [noise, mosaic, soft, mosaic[::4, ::4].copy(), mosaic[:224, :224].copy()]


@pytest.mark.parametrize("which", range(5))
def test_resize_and_crop_are_tensorflows(which: int) -> None:
    picture = pictures()[which]
    wanted = tf.image.resize(picture, (224, 224), method="lanczos3", antialias=True)
    wanted = tf.cast(tf.clip_by_value(tf.round(wanted), 0, 255), tf.uint8)
    same(lanczos(picture, 224), wanted.numpy())

    part = math.sqrt(0.9)
    box = [(1 - part) / 2, (1 - part) / 2, (1 + part) / 2, (1 + part) / 2]
    whole = tf.image.convert_image_dtype(wanted, tf.float32)[None]
    cropped = tf.image.crop_and_resize(whole, [box], [0], (224, 224))[0]
    cropped = tf.clip_by_value(cropped, 0, 1)
    cropped = tf.image.convert_image_dtype(cropped, tf.uint8, saturate=True)
    same(centre_crop(wanted.numpy()), cropped.numpy())


@pytest.mark.parametrize("which", range(5))
def test_jpeg_is_tensorflows_but_for_its_decoder(which: int) -> None:
    picture = pictures()[which]
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    ours = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    theirs = tf.image.encode_jpeg(picture).numpy()
    exact = tf.io.decode_jpeg(theirs, dct_method="INTEGER_ACCURATE").numpy()
    np.testing.assert_array_equal(decoded(ours), exact)
    coarse = tf.io.decode_jpeg(theirs).numpy().astype(int)
    assert np.abs(decoded(ours) - coarse).mean() < DECODED


def decoded(data: bytes) -> Picture:
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def same(ours: Picture, theirs: Picture) -> None:
    apart = np.abs(ours.astype(int) - theirs)
    assert apart.max() <= ROUNDED
    assert (apart > 0).mean() < ROUNDED_SHARE
