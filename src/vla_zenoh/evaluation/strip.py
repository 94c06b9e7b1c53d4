"""Pictures at chosen moments: what each camera took, and what the model was given of it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import CodecError, SpecError
from vla_zenoh.evaluation.result import View
from vla_zenoh.observe import prepare
from vla_zenoh.policy import CameraSpec
from vla_zenoh.recording.run import Picture, Run, pictures
from vla_zenoh.types import ActionChunk, Image

HEIGHT_PX = 150
QUALITY = 80


def views_of(run: Run, chunks: Sequence[ActionChunk], count: int) -> list[View]:
    """For each camera `count` pictures, evenly over the run.

    With chunks they are the pictures that chunks were made of; where the model asks for another
    size, what it was given stands beside them.
    """
    stamps = [chunk.observation_stamp_ns for chunk in chunks]
    if not stamps:
        stamps = [int(ns) for ns in np.linspace(run.began_ns, run.ended_ns, 2 * count + 1)[1::2]]
    elif len(stamps) > count:
        stamps = [stamps[int(i)] for i in np.linspace(0, len(stamps) - 1, count)]
    specs = {chunk.spec_hash for chunk in chunks}
    asked = {
        camera.camera: camera
        for name in specs & run.specs.keys()
        for camera in run.specs[name].observation.cameras
    }
    out: list[View] = []
    for camera in sorted(run.picture_counts):
        for found in _nearest(run, camera, stamps):
            out += _views(run, camera, found, asked.get(camera))
    return out


def _nearest(run: Run, camera: str, stamps: Sequence[int]) -> list[Picture]:
    """For each stamp the picture that was taken nearest to it, in one pass over the file."""
    best: list[Picture | None] = [None] * len(stamps)
    for picture in pictures(run.file, camera):
        for index, stamp_ns in enumerate(stamps):
            known = best[index]
            distance = abs(picture.stamp_ns - stamp_ns)
            if known is None or distance < abs(known.stamp_ns - stamp_ns):
                best[index] = picture
    return [picture for picture in best if picture is not None]


def _views(run: Run, camera: str, found: Picture, asked: CameraSpec | None) -> list[View]:
    try:
        image = image_codec.decode_jpeg(found.jpeg)
    except CodecError:
        return []  # told when the run was read
    t_s = (found.stamp_ns - run.began_ns) / 1e9
    out = [View(t_s, camera, _small(image.rgb))]
    if asked is not None and asked.width is not None:
        try:
            given = prepare(image, asked.model_copy(update={"colour": "rgb"}))
        except SpecError:
            return out
        out.append(View(t_s, camera, _small(given), model=True))
    return out


def _small(rgb: NDArray[np.uint8]) -> bytes:
    height, width = rgb.shape[:2]
    if height > HEIGHT_PX:
        size = (max(1, round(width * HEIGHT_PX / height)), HEIGHT_PX)
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image_codec.encode_jpeg(Image(np.ascontiguousarray(rgb)), QUALITY)
