"""Images of a camera as MP4, with the prompt drawn in."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import CodecError
from vla_zenoh.lab.video import VideoWriter

VIDEO_HZ = 15
STRIP_PX = 36
QUALITY = "24"  # x264's constant rate factor: visually good, some 100 KB a second at most


def write_video(
    path: Path,
    frames: Sequence[tuple[int, bytes]],
    marks: Sequence[tuple[int, str]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write an MP4 at a constant rate; returns the number of its frames, 0: there were none.

    Args:
        path: of the file.
        frames: (wall ns, JPEG), oldest first.
        marks: (wall ns, prompt).
        progress: called with (frames done, frames in all).

    Raises:
        MissingExtraError: PyAV is not installed.
    """
    if not frames:
        return 0
    stamps = [stamp_ns for stamp_ns, _ in frames]
    total = max(1, int((stamps[-1] - stamps[0]) / 1e9 * VIDEO_HZ))
    shown, picture = -1, None
    video = VideoWriter(path, VIDEO_HZ, extra="sim", crf=QUALITY)
    try:
        for index in range(total):
            now_ns = stamps[0] + int(index / VIDEO_HZ * 1e9)
            newest = bisect_right(stamps, now_ns) - 1
            if newest != shown or picture is None:
                shown = newest
                picture = _decode(frames[newest][1])
            if picture is None:
                continue
            video.add(_write_prompt(picture, _prompt_at(marks, now_ns)))
            progress(index + 1, total)
    finally:
        video.close()
    return total


def _decode(jpeg: bytes) -> NDArray[np.uint8] | None:
    try:
        return image_codec.decode_jpeg(jpeg).rgb
    except CodecError:
        return None


def _prompt_at(marks: Sequence[tuple[int, str]], now_ns: int) -> str:
    return next((prompt for stamp_ns, prompt in reversed(marks) if stamp_ns <= now_ns), "")


def _write_prompt(picture: NDArray[np.uint8], prompt: str) -> NDArray[np.uint8]:
    if not prompt:
        return picture
    out = picture.copy()
    strip = out[-STRIP_PX:]
    strip[:] = strip // 3
    at = (12, out.shape[0] - STRIP_PX // 3)
    cv2.putText(out, prompt, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 1, cv2.LINE_AA)
    return out
