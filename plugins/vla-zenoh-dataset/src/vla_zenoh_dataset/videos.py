"""Images of an episode as a video, with one video frame for each frame of the episode."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.run import Run, depths, pictures
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.lab.video import VideoWriter
from vla_zenoh.types import Depth
from vla_zenoh_dataset.episodes import EpisodeGap, RecordedEpisode
from vla_zenoh_dataset.features import PICTURE, Histogram

OPTIONS = {"crf": "18", "g": "2", "bf": "0"}
"""Every second frame is a key frame, so that training can seek to any frame quickly."""
OLDEST_NS = 500_000_000


def stamps_of(run: Run, camera: str) -> list[int]:
    """Time of capture of each image, in the order of reception."""
    return [picture.stamp_ns for picture in pictures(run.file, camera)]


def with_images(
    episodes: Sequence[RecordedEpisode], cameras: Sequence[str], depth: Sequence[str]
) -> tuple[list[RecordedEpisode], list[str]]:
    """Episodes with an image of every camera at every frame, each from its first such frame.

    Returns:
        them, and why each of the others is left out.

    Raises:
        RecordingError: a recording has no image of a camera.
    """
    readers = [(pictures, camera, "images") for camera in cameras]
    readers += [(depths, camera, "depth images") for camera in depth]
    found: dict[int, list[list[int]]] = {}
    kept, gaps = list[RecordedEpisode](), list[str]()
    for episode in episodes:
        file = episode.run.file
        if id(file) not in found:
            found[id(file)] = [
                [each.stamp_ns for each in read(file, camera)] for read, camera, _ in readers
            ]
        stamps = found[id(file)]
        begins_ns = max((each[0] for each in stamps if each), default=0)
        frames = [frame for frame in episode.frames if frame.stamp_ns >= begins_ns]
        whole = replace(episode, frames=frames)
        try:
            if not frames:
                raise EpisodeGap(
                    f"{episode.named} ended before the first image of one of its cameras"
                )
            for (_, camera, kind), each in zip(readers, stamps, strict=True):
                chosen(whole, camera, each, kind)
        except EpisodeGap as gap:
            gaps.append(str(gap))
        else:
            kept.append(whole)
    return kept, gaps


def chosen(
    episode: RecordedEpisode, camera: str, stamps: list[int], kind: str = "images"
) -> list[int]:
    """Number of the newest image captured before each frame.

    Raises:
        EpisodeGap: there is none for a frame, or only one that is too old.
        RecordingError: the recording has no image.
    """
    # One that came after a newer one is left out, as a worker leaves it out.
    newest = [-1, *accumulate(stamps, max)]
    order = [index for index, stamp in enumerate(stamps) if stamp > newest[index]]
    in_time = [stamps[index] for index in order]
    if not in_time:
        there = ", ".join(sorted(episode.run.picture_counts)) or "none"
        raise RecordingError(
            f"{episode.run.path} has no {kind} of camera {camera!r}; it has images of: {there}"
        )
    out = []
    for frame in episode.frames:
        at = bisect_right(in_time, frame.stamp_ns) - 1
        if at < 0 or frame.stamp_ns - in_time[at] > OLDEST_NS:
            raise EpisodeGap(
                f"{episode.named} has no {kind} of camera {camera!r} within "
                f"{OLDEST_NS / 1e9:g} s before its frame at {episode.after_s(frame.stamp_ns):.1f} s"
            )
        out.append(order[at])
    return out


class EpisodeVideo(NamedTuple):
    """The MP4 of one episode and camera, and the histogram of its images."""

    video: VideoWriter
    histogram: Histogram


def write_videos(
    run: Run, camera: str, wanted: list[tuple[Path, list[int]]], fps: int
) -> list[EpisodeVideo]:
    """Write the videos of all episodes of a run while reading its images once.

    Args:
        wanted: file and image numbers of each episode; numbers never decrease.

    Raises:
        RecordingError: images of one episode differ in size.
        CodecError: one is no JPEG file.
    """
    videos = [EpisodeVideo(VideoWriter(path, fps, **OPTIONS), Histogram()) for path, _ in wanted]
    users: dict[int, list[tuple[int, int]]] = {}
    for which, (_, numbers) in enumerate(wanted):
        for number in sorted(set(numbers)):
            users.setdefault(number, []).append((which, numbers.count(number)))
    try:
        for number, picture in enumerate(pictures(run.file, camera)):
            for which, times in users.get(number, ()):
                video, histogram = videos[which]
                histogram.add(video.add(image_codec.decode_jpeg(picture.jpeg).rgb, times))
    finally:
        for video, _ in videos:
            video.close()
    return videos


MILLIMETRE_M = 1e-3
LEVELS = 2**16


class DepthColumn:
    """Depth images of all episodes, read in their order.

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
        while self._at < number:
            self._newest, self._at = next(self._entries), self._at + 1
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
        assert self._first is not None
        return {
            "dtype": "image",
            "shape": [*self._first.counts.shape, 1],
            "names": ["height", "width", "channels"],
            "info": {"is_depth_map": True, "depth_unit": self.unit},
        }


def _metres(depth: Depth) -> bytes:
    from vla_zenoh.opencv import cv2

    ok, data = cv2.imencode(".tiff", (depth.counts * depth.unit_m).astype(np.float32))
    if not ok:
        raise RecordingError(f"no TIFF could be made of {depth.counts.shape} depths")
    return data.tobytes()
