"""What a calibration is made of: the corners of a board in an image, and where the arm was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.kinematics.so3 import log3, orthonormal
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.board import Board, Corners

ROWS = ("top", "middle", "bottom")
COLUMNS = ("left", "centre", "right")
MIN_IN_PART = 4
"""Corners in a ninth of the image that count as the board seen there."""
MIN_TURN_RAD = 0.12
"""What the arm's poses turn about the weakest of two axes, as the mean over all views (rms)."""


@dataclass(frozen=True, eq=False)
class View:
    """A board in an image.

    Args:
        corners: of the board.
        arm: (4, 4) measured pose of the link at the end of the arm, in the arm's base, m; None: no
            arm has to do with it.
        stamp_ns: of the image, wall clock of the camera's host.
    """

    corners: Corners
    arm: FloatArray | None = None
    stamp_ns: int = 0

    @property
    def ids(self) -> NDArray[np.int32]:
        return self.corners.ids

    @property
    def pixels(self) -> FloatArray:
        return self.corners.pixels


class Turns(NamedTuple):
    """How the arm's poses turn against their mean.

    Args:
        rms_rad: (3,) about the principal axes, the largest first.
        axes: (3, 3) those axes in the base, as rows.
    """

    rms_rad: FloatArray
    axes: FloatArray


def placed(rotation: ArrayLike, position_m: ArrayLike) -> FloatArray:
    """A pose (4, 4) of a rotation (3, 3) and a position (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position_m
    return pose


def inverse(pose: FloatArray) -> FloatArray:
    """The inverse of a pose (4, 4)."""
    back = pose[:3, :3].T
    return placed(back, -back @ pose[:3, 3])


def turns(poses: Sequence[FloatArray]) -> Turns:
    """How poses (4, 4) turn against their mean."""
    rotations = np.array([pose[:3, :3] for pose in poses])
    mean = _mean_rotation(rotations)
    vectors = np.array([log3(rotation @ mean.T) for rotation in rotations])
    _, sizes, axes = np.linalg.svd(vectors, full_matrices=len(vectors) < 3)
    rms = np.zeros(3)
    rms[: len(sizes)] = sizes / np.sqrt(len(vectors))
    return Turns(rms, axes[:3])


def _mean_rotation(rotations: FloatArray) -> FloatArray:
    """The rotation nearest to all, by their sum."""
    left, _, right = np.linalg.svd(rotations.sum(axis=0))
    return orthonormal(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def covered(views: Sequence[View], size: tuple[int, int]) -> NDArray[np.bool_]:
    """(3, 3) ninths of the image, rows from the top, in which some view has the board.

    Args:
        size: width and height of the images, pixels.
    """
    counts = np.zeros((3, 3), int)
    for view in views:
        here = np.zeros((3, 3), int)
        columns, rows = (view.pixels * 3 / size).astype(int).clip(0, 2).T
        np.add.at(here, (rows, columns), 1)
        counts += here >= MIN_IN_PART
    return counts > 0


def uncovered(views: Sequence[View], size: tuple[int, int]) -> list[str]:
    """Names of the parts of the image in which the board was in no view, as ``top left``."""
    rows, columns = np.nonzero(~covered(views, size))
    return [f"{ROWS[row]} {COLUMNS[column]}" for row, column in zip(rows, columns, strict=True)]


def tilts(board: Board, views: Sequence[View]) -> FloatArray:
    """(n,) how unequal a board's opposite sides look: 0 seen straight on, 0.2 clearly tilted.

    Perspective alone makes them unequal, so no lens has to be known.
    """
    width, height = board.size_m
    frame = np.array([[[0, 0], [width, 0], [width, height], [0, height]]], np.float64)
    out: list[float] = []
    for view in views:
        plane, _ = cv2.findHomography(board.points_m[view.ids, :2], view.pixels)
        if plane is None:
            out.append(0.0)
            continue
        a, b, c, d = cv2.perspectiveTransform(frame, plane)[0]
        sides = [float(np.linalg.norm(x - y)) for x, y in ((a, b), (c, d), (b, c), (d, a))]
        out.append(max(abs(np.log(sides[0] / sides[1])), abs(np.log(sides[2] / sides[3]))))
    return np.array(out)
