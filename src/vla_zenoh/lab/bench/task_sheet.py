"""Contact sheet of outcomes: start and end of each episode, with its prompt."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.lab.bench.task import TaskOutcome
from vla_zenoh.types import Image

TILE_WIDTH, TILE_HEIGHT, TEXT_HEIGHT = 240, 180, 60
COLUMNS, MAX_TILES = 3, 60
LETTERS = 76

Picture = NDArray[np.uint8]


def failure_sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first failures with pictures; None: there are none."""
    return sheet([each for each in ended if not each.success])


def sheet(ended: Sequence[TaskOutcome]) -> bytes | None:
    """A JPEG of the first outcomes with pictures; None: there are none."""
    shown = [each for each in ended if each.pictures is not None][:MAX_TILES]
    if not shown:
        return None
    tiles = [_tile(each) for each in shown]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % min(COLUMNS, len(tiles)))
    columns = min(COLUMNS, len(tiles))
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return encode_jpeg(Image(np.ascontiguousarray(np.vstack(rows))))


def _tile(ended: TaskOutcome) -> Picture:
    assert ended.pictures is not None
    tile = np.full((TILE_HEIGHT + TEXT_HEIGHT, 2 * TILE_WIDTH, 3), 255, np.uint8)
    for index, jpeg in enumerate(ended.pictures):
        if jpeg:
            small = cv2.resize(
                decode_jpeg(jpeg).rgb, (TILE_WIDTH, TILE_HEIGHT), interpolation=cv2.INTER_AREA
            )
            tile[:TILE_HEIGHT, index * TILE_WIDTH : (index + 1) * TILE_WIDTH] = small
    title = f"{ended.episode.seed}: {ended.failure or 'done'}, {ended.time_s:.1f} s"
    # OpenCV draws only ASCII.
    prompt = ended.prompt.encode("ascii", "replace").decode()
    for row, line in enumerate([title, *textwrap.wrap(prompt, LETTERS)[:2]]):
        cv2.putText(
            tile,
            line,
            (6, TILE_HEIGHT + 18 + 16 * row),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.38,
            (180, 0, 0) if row == 0 and not ended.success else (0, 0, 0),
            1,
            cv2.LINE_AA,
        )
    return tile
