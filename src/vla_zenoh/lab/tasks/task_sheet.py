"""Sheet of outcomes: start and end of each episode side by side, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.lab.tasks.task import STAY, TaskOutcome, is_judged
from vla_zenoh.opencv import cv2
from vla_zenoh.types import Image

FRAME_WIDTH, FRAME_HEIGHT, TITLE_HEIGHT, GAP = 560, 420, 56, 8
WIDTH, HEIGHT = 2 * FRAME_WIDTH + 3 * GAP, TITLE_HEIGHT + FRAME_HEIGHT + GAP
LABEL_WIDTH, LABEL_HEIGHT, RADIUS = 100, 32, 17
MAX_EPISODES, ROWS = 30, 15
"""A JPEG's side is 8192 px at most: with more than 15 episodes there are two columns."""
GREEN, RED, GREY, INK = (24, 140, 60), (200, 30, 30), (110, 110, 110), (25, 30, 36)
PAPER, EMPTY = 255, 235

Picture = NDArray[np.uint8]


def sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first outcomes with pictures; None: there are none."""
    shown = [each for each in ended if each.pictures is not None][:MAX_EPISODES]
    if not shown:
        return None
    columns = math.ceil(len(shown) / ROWS)
    page = np.full((min(len(shown), ROWS) * HEIGHT, columns * WIDTH, 3), PAPER, np.uint8)
    for index, each in enumerate(shown):
        column, row = divmod(index, ROWS)
        left, top = column * WIDTH, row * HEIGHT
        _draw(page[top : top + HEIGHT, left : left + WIDTH], each)
    return encode_jpeg(Image(page))


def _draw(row: Picture, ended: TaskOutcome) -> None:
    """Draw an outcome: a disc in its colour, prompt and verdict, then both pictures."""
    assert ended.pictures is not None
    colour, word = GREEN if ended.success else RED, ended.failure.replace("_", " ") or "done"
    if ended.success and ended.episode.order.family == STAY and not is_judged(ended.prompt):
        colour, word = GREY, "not judged"
    cv2.circle(row, (GAP + RADIUS, TITLE_HEIGHT // 2), RADIUS, colour, -1, cv2.LINE_AA)
    _write(row, f"{ended.prompt}: {word}, {ended.time_s:.1f} s", 2 * (GAP + RADIUS), 36, colour)
    for index, (jpeg, label) in enumerate(zip(ended.pictures, ("before", "after"), strict=True)):
        left = GAP + index * (FRAME_WIDTH + GAP)
        frame = row[TITLE_HEIGHT : TITLE_HEIGHT + FRAME_HEIGHT, left : left + FRAME_WIDTH]
        frame[:] = EMPTY
        if jpeg:
            small = decode_jpeg(jpeg).rgb
            frame[:] = cv2.resize(small, (FRAME_WIDTH, FRAME_HEIGHT), interpolation=cv2.INTER_AREA)
        frame[:LABEL_HEIGHT, :LABEL_WIDTH] = PAPER
        _write(frame, label, GAP, LABEL_HEIGHT - GAP, INK)


def _write(picture: Picture, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    plain = text.encode("ascii", "replace").decode()  # OpenCV draws only ASCII
    cv2.putText(picture, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
