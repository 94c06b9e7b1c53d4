"""The pictures of an episode as a video: one frame for each of its frames."""

from __future__ import annotations

from bisect import bisect_right
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import MissingExtraError, RecordingError
from vla_zenoh.lab.dataset.episodes import RecordedEpisode
from vla_zenoh.lab.dataset.feature_statistics import Colours
from vla_zenoh.lab.recording.run import Run, pictures

CODEC, PIXELS = "libx264", "yuv420p"
OPTIONS = {"crf": "18", "preset": "veryfast", "g": "2", "bf": "0"}
"""Every other picture is whole, so that training finds any one quickly."""
OLDEST_NS = 500_000_000


def stamps_of(run: Run, camera: str) -> list[int]:
    """When each picture was taken, in the order in which they were heard."""
    return [picture.stamp_ns for picture in pictures(run.file, camera)]


def chosen(episode: RecordedEpisode, camera: str, stamps: list[int]) -> list[int]:
    """For each frame the newest picture that was not taken after it.

    Raises:
        RecordingError: there is none, or only one that is too old.
    """
    order = sorted(range(len(stamps)), key=stamps.__getitem__)
    in_time = [stamps[index] for index in order]
    out = []
    for frame in episode.frames:
        at = max(bisect_right(in_time, frame.stamp_ns) - 1, 0)
        if not in_time or abs(frame.stamp_ns - in_time[at]) > OLDEST_NS:
            raise RecordingError(
                f"{episode.run.path}: no picture of camera {camera!r} within "
                f"{OLDEST_NS / 1e9:g} s before a frame; leave the camera out with --camera"
            )
        out.append(order[at])
    return out


class EpisodeVideo:
    """Writes one MP4.

    Args:
        path: of the file.
        fps: frames per second.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, path: Path, fps: int) -> None:
        try:
            import av
        except ImportError as error:
            raise MissingExtraError("av", "dataset") from error
        self._av, self.fps = av, fps
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container: Any = av.open(str(path), "w")
        self._stream: Any = None
        self.size = (0, 0)
        """Height and width; even, as the codec wants it: an odd last row or column is cut off."""
        self.colours = Colours()

    def add(self, jpeg: bytes, times: int) -> None:
        """Append a picture as so many frames.

        Raises:
            RecordingError: it has another size than those before.
            CodecError: it is none.
        """
        rgb = image_codec.decode_jpeg(jpeg).rgb
        size = (rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2)
        if self._stream is None:
            self.size = size
            self._stream = self._container.add_stream(CODEC, rate=Fraction(self.fps))
            self._stream.height, self._stream.width = size
            self._stream.pix_fmt = PIXELS
            self._stream.options = dict(OPTIONS)
        if size != self.size:
            raise RecordingError(f"pictures of {self.size} and of {size} pixels in one dataset")
        cut = np.ascontiguousarray(rgb[: size[0], : size[1]])
        self.colours.see(cut)
        for _ in range(times):
            frame = self._av.VideoFrame.from_ndarray(cut, format="rgb24")
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()


def write_videos(
    run: Run, camera: str, wanted: list[tuple[Path, list[int]]], fps: int
) -> list[EpisodeVideo]:
    """Write the video of each episode of a run while its pictures are read once.

    Args:
        run: it is of.
        camera: whose pictures.
        wanted: for each episode the file and the numbers of its pictures, never falling.
        fps: frames per second.
    """
    videos = [EpisodeVideo(path, fps) for path, _ in wanted]
    users: dict[int, list[tuple[int, int]]] = {}
    for which, (_, numbers) in enumerate(wanted):
        for number in sorted(set(numbers)):
            users.setdefault(number, []).append((which, numbers.count(number)))
    try:
        for number, picture in enumerate(pictures(run.file, camera)):
            for which, times in users.get(number, ()):
                videos[which].add(picture.jpeg, times)
    finally:
        for video in videos:
            video.close()
    return videos
