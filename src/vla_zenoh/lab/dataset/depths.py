"""Depth images of a camera as LeRobot 0.6 keeps raw depth: files in a column of the frames.

In millimetres they are the 16-bit PNG files of the recording; of another unit TIFF files of float32
metres, which lose nothing either.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.dataset.episodes import RecordedEpisode
from vla_zenoh.lab.dataset.feature_statistics import Histogram
from vla_zenoh.lab.dataset.features import PICTURE
from vla_zenoh.lab.dataset.videos import chosen
from vla_zenoh.lab.recording.run import Run, depths
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.types import Depth

MILLIMETRE_M = 1e-3
LEVELS = 2**16


class DepthColumn:
    """Depth images of all episodes, read in their order.

    Args:
        camera: its name.

    Attributes:
        name: of the column, as LeRobot names depth.
        histograms: of the images of each episode.
    """

    def __init__(self, camera: str) -> None:
        self.camera, self.name = camera, f"{PICTURE}{camera}_depth"
        self.histograms: list[Histogram] = []
        self._first: Depth | None = None
        self._run: Run | None = None
        self._stamps: list[int] = []
        self._entries: Iterator[Sample] = iter(())
        self._at = -1

    def files(self, episode: RecordedEpisode) -> list[dict[str, Any]]:
        """The file of each frame, as a value of LeRobot's type ``image``.

        Raises:
            RecordingError: a frame has no depth; sizes or units differ.
            CodecError: an image cannot be decoded.
        """
        if episode.run is not self._run:
            self._run, self._at = episode.run, -1
            found = depths(episode.run.file, self.camera)
            self._stamps = [sample.stamp_ns for sample in found]
        numbers = chosen(episode, self.camera, self._stamps, "depth images")
        files: dict[int, bytes] = {}
        histogram: Histogram | None = None
        for number in sorted(set(numbers)):
            sample = self._sample(episode.run, number)
            depth = sample.depth()
            self._check(episode, depth)
            step = 1.0 if self.unit == "mm" else depth.unit_m
            histogram = histogram or Histogram(step, 1, LEVELS)
            histogram.add(depth.counts)
            files[number] = sample.payload if self.unit == "mm" else _metres(depth)
        assert histogram is not None
        self.histograms.append(histogram)
        return [{"bytes": files[number], "path": None} for number in numbers]

    def _sample(self, run: Run, number: int) -> Sample:
        """A sample by its number; the file is read once if these grow."""
        if self._at < 0 or number < self._at:
            self._entries, self._at = depths(run.file, self.camera), -1
        if number > self._at:
            for _ in range(number - self._at):
                self._newest = next(self._entries)
            self._at = number
        return self._newest

    def _check(self, episode: RecordedEpisode, depth: Depth) -> None:
        first = self._first = self._first or depth
        for what, wanted, found in (
            ("size", first.counts.shape, depth.counts.shape),
            ("unit", first.unit_m, depth.unit_m),
        ):
            if wanted != found:
                raise RecordingError(
                    f"{episode.run.path}: the depth of camera {self.camera!r} has the {what} "
                    f"{found}, before it was {wanted}; export these runs apart, or with --no-depth"
                )

    @property
    def unit(self) -> str:
        """LeRobot's unit of the values: ``mm`` or ``m``."""
        assert self._first is not None
        return "mm" if abs(self._first.unit_m / MILLIMETRE_M - 1) < 1e-9 else "m"

    def feature(self) -> dict[str, Any]:
        """LeRobot's description of the column."""
        assert self._first is not None
        return {
            "dtype": "image",
            "shape": [*self._first.counts.shape, 1],
            "names": ["height", "width", "channels"],
            "info": {"is_depth_map": True, "depth_unit": self.unit},
        }


def _metres(depth: Depth) -> bytes:
    ok, data = cv2.imencode(".tiff", (depth.counts * depth.unit_m).astype(np.float32))
    if not ok:
        raise RecordingError(f"no TIFF could be made of {depth.counts.shape} depths")
    return data.tobytes()
