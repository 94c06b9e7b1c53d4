"""Sheet of outcomes: start and end of each episode side by side, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.lab.bench.task import STAY, TaskOutcome, is_judged
from vla_zenoh.types import Image

FRAME_WIDTH, FRAME_HEIGHT, TITLE_HEIGHT, GAP = 560, 420, 56, 8
MAX_EPISODES, ROWS = 30, 15
"""A JPEG's side is 8192 px at most: with more than 15 episodes there are two columns."""
MARK_PX = 34
GREEN, RED, GREY = (24, 140, 60), (200, 30, 30), (110, 110, 110)
INK, PAPER, SOFT = (25, 30, 36), 255, (90, 98, 106)
FONT = cv2.FONT_HERSHEY_SIMPLEX

Picture = NDArray[np.uint8]


def failure_sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first failures with pictures; None: there are none."""
    return sheet([each for each in ended if not each.success])


def sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first outcomes with pictures; None: there are none."""
    shown = [each for each in ended if each.pictures is not None][:MAX_EPISODES]
    if not shown:
        return None
    rows = [_row(each) for each in shown]
    columns = [np.vstack(rows[at : at + ROWS]) for at in range(0, len(rows), ROWS)]
    height = columns[0].shape[0]
    filled = [
        np.pad(each, ((0, height - len(each)), (0, 0), (0, 0)), constant_values=PAPER)
        for each in columns
    ]
    return encode_jpeg(Image(np.ascontiguousarray(np.hstack(filled))))


def _row(ended: TaskOutcome) -> Picture:
    assert ended.pictures is not None
    width, height = 2 * FRAME_WIDTH + 3 * GAP, TITLE_HEIGHT + FRAME_HEIGHT + GAP
    row = np.full((height, width, 3), PAPER, np.uint8)
    told = ended.episode.order.family != STAY or is_judged(ended.prompt)
    judged = told or not ended.success
    colour = GREY if not judged else GREEN if ended.success else RED
    _mark(row, colour, done=ended.success, judged=judged)
    word = "not judged" if not judged else ended.failure.replace("_", " ") or "done"
    text = f"{word}, {ended.time_s:.1f} s"
    size, _ = cv2.getTextSize(text, FONT, 0.7, 2)
    prompt = ended.prompt.encode("ascii", "replace").decode()  # OpenCV draws only ASCII
    _write(row, prompt, (GAP + MARK_PX + 14, 36), 0.8, INK)
    _write(row, text, (width - size[0] - 2 * GAP, 36), 0.7, colour)
    for index, (jpeg, label) in enumerate(zip(ended.pictures, ("before", "after"), strict=True)):
        left = GAP + index * (FRAME_WIDTH + GAP)
        frame = row[TITLE_HEIGHT : TITLE_HEIGHT + FRAME_HEIGHT, left : left + FRAME_WIDTH]
        frame[:] = 235
        if jpeg:
            small = decode_jpeg(jpeg).rgb
            frame[:] = cv2.resize(small, (FRAME_WIDTH, FRAME_HEIGHT), interpolation=cv2.INTER_AREA)
        size, _ = cv2.getTextSize(label, FONT, 0.6, 1)
        frame[: size[1] + 16, : size[0] + 20] = PAPER
        _write(frame, label, (10, size[1] + 7), 0.6, SOFT)
    return row


def _mark(row: Picture, colour: tuple[int, int, int], *, done: bool, judged: bool) -> None:
    """A disc with a tick, a cross, or a dash if it was not judged."""
    x, y, r = GAP + MARK_PX // 2, TITLE_HEIGHT // 2, MARK_PX // 2
    cv2.circle(row, (x, y), r, colour, -1, cv2.LINE_AA)
    if not judged:
        lines = [((-8, 0), (8, 0))]
    elif done:
        lines = [((-8, 1), (-2, 7)), ((-2, 7), (8, -6))]
    else:
        lines = [((-6, -6), (6, 6)), ((-6, 6), (6, -6))]
    for (x0, y0), (x1, y1) in lines:
        cv2.line(row, (x + x0, y + y0), (x + x1, y + y1), (255, 255, 255), 3, cv2.LINE_AA)


def _write(
    picture: Picture, text: str, at: tuple[int, int], scale: float, colour: tuple[int, int, int]
) -> None:
    cv2.putText(picture, text, at, FONT, scale, colour, 1 if scale < 0.7 else 2, cv2.LINE_AA)
