"""A recording as MP4: its cameras side by side, with clock, prompt, state and verdicts."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.lab.recording.run import Run
from vla_zenoh.lab.recording.sample import JPEG
from vla_zenoh.lab.video import VideoWriter, decoded_at_height
from vla_zenoh.opencv import cv2

STRIP, TEXT = 0.085, 0.026
"""Height of the strip below the images, and of letters in it, as shares of the height."""
VERDICT_NS = 2_000_000_000
"""How long a verdict is shown."""
GREEN, RED, WHITE = (120, 230, 130), (255, 120, 110), (255, 255, 255)

FONT = cv2.FONT_HERSHEY_SIMPLEX

Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Film:
    """How a film looks. `quality`: x264's constant rate factor; lower is better."""

    height_px: int = 480
    rate_hz: int = 15
    quality: int = 24


def write_film(
    path: Path,
    run: Run,
    look: Film,
    verdicts: Sequence[tuple[int, str, bool]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write a film that begins and ends with the recording; returns the number of its frames.

    Args:
        run: with images; without any, no file is written.
        verdicts: (wall ns, text, success), oldest first.
        progress: called with (frames done, frames in all).
    """
    cameras = sorted(run.picture_counts)
    if not cameras:
        return 0
    keys = {run.keys.camera_jpeg(camera): camera for camera in cameras}
    total, done = max(1, int(run.seconds * look.rate_hz)), 0
    newest: dict[str, bytes] = {}
    shown: dict[str, tuple[bytes, Picture]] = {}
    writer = VideoWriter(path, look.rate_hz, crf=str(look.quality))

    def draw(until_ns: int) -> None:
        nonlocal done
        while done < total and (now_ns := run.began_ns + int(done / look.rate_hz * 1e9)) < until_ns:
            for camera, jpeg in newest.items():
                if camera not in shown or shown[camera][0] is not jpeg:
                    shown[camera] = (jpeg, decoded_at_height(jpeg, look.height_px))
            pictures = [shown[camera][1] for camera in cameras if camera in shown]
            frame = _beside(pictures, len(cameras), look.height_px)
            writer.add(_write_caption(frame, run, verdicts, now_ns))
            done += 1
            progress(done, total)

    try:
        for entry in run.file.entries(lambda key: key in keys):
            if entry.encoding != JPEG:
                continue
            if len(newest) == len(cameras):  # the first images decide the size
                draw(entry.received_ns)
            newest[keys[entry.key]] = entry.payload
        draw(run.ended_ns + 1)
    finally:
        writer.close()
    return done


def _beside(pictures: Sequence[Picture], count: int, height_px: int) -> Picture:
    missing = [np.zeros_like(pictures[0])] * (count - len(pictures))
    strip = np.zeros((round(STRIP * height_px), sum(p.shape[1] for p in (*pictures, *missing)), 3))
    return np.vstack([np.hstack([*pictures, *missing]), strip.astype(np.uint8)])


def _write_caption(
    picture: Picture, run: Run, verdicts: Sequence[tuple[int, str, bool]], now_ns: int
) -> Picture:
    """Draw the text of the strip at a time into a picture; returns it."""
    at = bisect_right(run.tasks, now_ns, key=lambda entry: entry.received_ns) - 1
    task = run.tasks[at].record if at >= 0 else None
    left = f"{(now_ns - run.began_ns) / 1e9:5.1f} s   {task.prompt if task else ''}"
    right, colour = "", WHITE
    if task is not None:
        right = f"{task.worker} {task.rate_hz:g} Hz, {'active' if task.active else 'inactive'}"
    for stamp_ns, text, success in verdicts:
        if stamp_ns <= now_ns < stamp_ns + VERDICT_NS:
            right, colour = text, GREEN if success else RED
    # OpenCV draws only ASCII.
    left, right = (text.encode("ascii", "replace").decode() for text in (left, right))
    scale = TEXT * picture.shape[0] / cv2.getTextSize("X", FONT, 1.0, 1)[0][1]
    width = cv2.getTextSize(right, FONT, scale, 1)[0][0]
    margin = round(TEXT * picture.shape[0])
    below = picture.shape[0] - margin
    end = picture.shape[1] - width - margin
    for text, x, ink in ((left, margin, WHITE), (right, end, colour)):
        cv2.putText(picture, text, (x, below), FONT, scale, ink, 1, cv2.LINE_AA)
    return picture
