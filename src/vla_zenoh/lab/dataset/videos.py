"""Images of an episode as a video, with one video frame for each frame of the episode."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.dataset.episodes import RecordedEpisode
from vla_zenoh.lab.dataset.feature_statistics import Histogram
from vla_zenoh.lab.recording.run import Run, pictures
from vla_zenoh.lab.video import VideoWriter

OPTIONS = {"crf": "18", "g": "2", "bf": "0"}
"""Every second frame is a key frame, so that training can seek to any frame quickly."""
OLDEST_NS = 500_000_000


def stamps_of(run: Run, camera: str) -> list[int]:
    """Time of capture of each image, in the order of reception."""
    return [picture.stamp_ns for picture in pictures(run.file, camera)]


def chosen(
    episode: RecordedEpisode, camera: str, stamps: list[int], kind: str = "images"
) -> list[int]:
    """Number of the newest image captured before each frame.

    Args:
        episode: its frames.
        camera: its name.
        stamps: of the images.
        kind: of images, for messages.

    Raises:
        RecordingError: no image, or only one that is too old.
    """
    order = sorted(range(len(stamps)), key=stamps.__getitem__)
    in_time = [stamps[index] for index in order]
    out = []
    for frame in episode.frames:
        at = max(bisect_right(in_time, frame.stamp_ns) - 1, 0)
        if not in_time or abs(frame.stamp_ns - in_time[at]) > OLDEST_NS:
            if not in_time:
                there = ", ".join(sorted(episode.run.picture_counts)) or "none"
                raise RecordingError(
                    f"{episode.run.path} has no {kind} of camera {camera!r}; it has images of: "
                    f"{there}"
                )
            raise RecordingError(
                f"{episode.run.path}: no {kind} of camera {camera!r} within "
                f"{OLDEST_NS / 1e9:g} s before a frame; leave the camera out with --camera"
            )
        out.append(order[at])
    return out


class EpisodeVideo:
    """The MP4 of one episode and camera, and the histogram of its images.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, path: Path, fps: int) -> None:
        self.video = VideoWriter(path, fps, extra="dataset", **OPTIONS)
        self.histogram = Histogram()

    def add(self, jpeg: bytes, count: int) -> None:
        """Append an image as `count` frames.

        Raises:
            RecordingError: its size differs from that of the images before.
            CodecError: it is no JPEG file.
        """
        self.histogram.add(self.video.add(image_codec.decode_jpeg(jpeg).rgb, count))


def write_videos(
    run: Run, camera: str, wanted: list[tuple[Path, list[int]]], fps: int
) -> list[EpisodeVideo]:
    """Write the videos of all episodes of a run while reading its images once.

    Args:
        run: the recorded run.
        camera: its name.
        wanted: file and image numbers of each episode; numbers never decrease.
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
            video.video.close()
    return videos
