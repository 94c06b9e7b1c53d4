"""Film strip of a run: images of each camera at chosen moments, and the inputs of the model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import CodecError, SpecError
from vla_zenoh.lab.evaluation.result import CameraView
from vla_zenoh.lab.recording.run import RecordedImage, Run, pictures, seen_pictures
from vla_zenoh.lab.video import at_height
from vla_zenoh.policy import CameraSpec
from vla_zenoh.policy.observation import prepare_image
from vla_zenoh.types import ActionChunk, Image

HEIGHT_PX = 300
QUALITY = 80


def filmstrip(run: Run, chunks: Sequence[ActionChunk], count: int) -> list[CameraView]:
    """`count` images of each camera, evenly over the run.

    With chunks they are images that chunks were inferred from, each with the input of the model
    beside it: the recorded one, else one prepared by the spec if that resizes images.
    """
    stamps = [chunk.observation_stamp_ns for chunk in chunks]
    if not stamps:
        stamps = [int(ns) for ns in np.linspace(run.began_ns, run.ended_ns, 2 * count + 1)[1::2]]
    elif len(stamps) > count:
        stamps = [stamps[int(i)] for i in np.linspace(0, len(stamps) - 1, count)]
    out: list[CameraView] = []
    for camera in sorted(run.picture_counts):
        taken = _nearest(pictures(run.file, camera), stamps)
        asked = _asked(run, chunks, camera)
        given = {}
        for worker in dict.fromkeys(chunk.worker for chunk in chunks):
            seen = seen_pictures(run.file, worker, camera)
            given |= {picture.stamp_ns: picture for picture in _nearest(seen, stamps)}
        for picture in taken:
            out += _views(run, camera, picture, given.get(picture.stamp_ns), asked)
    return out


def _asked(run: Run, chunks: Sequence[ActionChunk], camera: str) -> CameraSpec | None:
    """The spec of a camera in the models' specs."""
    hashes = dict.fromkeys(chunk.spec_hash for chunk in chunks)
    specs = [run.specs[name] for name in hashes if name in run.specs]
    cameras = (each for spec in specs for each in spec.observation.cameras)
    return next((each for each in cameras if each.camera == camera), None)


def _nearest(found: Iterable[RecordedImage], stamps: Sequence[int]) -> list[RecordedImage]:
    """The image captured nearest to each stamp, in one pass over the file."""
    best: list[RecordedImage | None] = [None] * len(stamps)
    for picture in found:
        for index, stamp_ns in enumerate(stamps):
            known = best[index]
            distance = abs(picture.stamp_ns - stamp_ns)
            if known is None or distance < abs(known.stamp_ns - stamp_ns):
                best[index] = picture
    return [picture for picture in best if picture is not None]


def _views(
    run: Run,
    camera: str,
    taken: RecordedImage,
    given: RecordedImage | None,
    asked: CameraSpec | None,
) -> list[CameraView]:
    try:
        image = image_codec.decode_jpeg(taken.jpeg)
        t_s = (taken.stamp_ns - run.began_ns) / 1e9
        out = [CameraView(t_s, camera, _small(image.rgb))]
        if given is not None:
            seen = image_codec.decode_jpeg(given.jpeg).rgb
            out.append(CameraView(t_s, camera, _small(seen), model=True))
        elif asked is not None and asked.width is not None:
            seen = prepare_image(image, asked.model_copy(update={"colour": "rgb"}))
            out.append(CameraView(t_s, camera, _small(seen), model=True))
    except (CodecError, SpecError):
        return []  # not an image that can be shown
    return out


def _small(rgb: NDArray[np.uint8]) -> bytes:
    if rgb.shape[0] > HEIGHT_PX:
        rgb = at_height(rgb, HEIGHT_PX)
    return image_codec.encode_jpeg(Image(np.ascontiguousarray(rgb)), QUALITY)
