"""The lens of a camera, from views of a board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.board import Board
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.view import View, covered, placed, tilts, uncovered

MIN_VIEWS = 8
MIN_COVERED = 5
"""Ninths of the image: distortion is a guess where no corner was."""
MIN_TILT = 0.08
"""Of the most tilted views: straight on, a longer lens and a farther board look the same."""
MAX_FOCAL_SHARE = 0.01
"""Standard deviation of a focal length that is no result any more."""
MAX_RMS_PX = 3.0
MIN_NOISE_PX = 0.02
"""Of a coordinate of a corner: no camera is better, and no lens is known exactly."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated lens.

    Args:
        intrinsics: of images of the size of the calibration's.
        rms_px, worst_px: distance of corners from where the lens puts them: of all, and of the
            worst view (rms).
        focal_sd_px, centre_sd_px: standard deviations of focal length and principal point, by the
            corners' noise.
        information: (8, 8) inverse covariance of the `numbers_of` the intrinsics, by that noise.
    """

    intrinsics: Intrinsics
    rms_px: float
    worst_px: float
    focal_sd_px: float
    centre_sd_px: float
    information: FloatArray


def calibrate_lens(board: Board, views: Sequence[View], size: tuple[int, int]) -> Lens:
    """Focal lengths, principal point, k1, k2, p1 and p2 of OpenCV; k3 stays 0.

    Args:
        size: width and height of the images, pixels.

    Raises:
        CalibrationError: the views do not determine them; says which are missing.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"too few views for a lens: {len(views)} of at least {MIN_VIEWS}; 20 are good"
        )
    missing = uncovered(views, size)
    if covered(views, size).sum() < MIN_COVERED:
        raise CalibrationError(
            f"the board was in {9 - len(missing)} of 9 parts of the image, a lens needs "
            f"{MIN_COVERED}; show it also at the {', '.join(missing)}"
        )
    tilt = np.sort(tilts(board, views))[-MIN_VIEWS // 2 :].mean()
    if tilt < MIN_TILT:
        raise CalibrationError(
            "all views are alike: the board was straight on in each, where a longer lens and a "
            "farther board look the same; tilt it by 20 to 40 degrees, both ways"
        )
    points = [board.points_m[view.ids].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    guess, bend = np.eye(3), np.zeros(5)
    rms, matrix, bend, _, _, spread, _, each = cv2.calibrateCameraExtended(
        points, pixels, size, guess, bend, flags=cv2.CALIB_FIX_K3
    )
    sd = np.asarray(spread).ravel()
    focal_sd_px, centre_sd_px = float(np.hypot(*sd[:2])), float(np.hypot(*sd[2:4]))
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not np.isfinite(sd[:4]).all() or focal_sd_px > MAX_FOCAL_SHARE * fx:
        raise CalibrationError(
            f"the views leave the focal length open: {fx:.0f} px with a standard deviation of "
            f"{focal_sd_px:.0f}; add views with the board tilted and near, to the edges of the "
            "image"
        )
    if rms > MAX_RMS_PX:
        raise CalibrationError(
            f"no lens fits: corners are {rms:.1f} px off; is the board flat, and are all squares "
            f"of one size? It was taken for {board.written}"
        )
    bend = tuple(float(value) for value in np.asarray(bend).ravel()[:4])
    found = Intrinsics(
        width=size[0],
        height=size[1],
        fx_px=fx,
        fy_px=fy,
        cx_px=cx + 0.5,  # OpenCV's origin is the centre of the first pixel, ours its corner
        cy_px=cy + 0.5,
        distortion=bend,
    )
    information = _information(board, views, found) / max(rms**2 / 2, MIN_NOISE_PX**2)
    return Lens(found, float(rms), float(np.max(each)), focal_sd_px, centre_sd_px, information)


def numbers_of(lens: Intrinsics) -> FloatArray:
    """(8,) focal lengths and principal point as OpenCV has them, px; k1, k2, p1, p2."""
    matrix = lens.matrix
    centre = matrix[0, 2], matrix[1, 2]
    return np.array([lens.fx_px, lens.fy_px, *centre, *distortion_of(lens)[:4]])


def lens_of(numbers: FloatArray, like: Intrinsics) -> Intrinsics:
    """The inverse of `numbers_of`; size and k3 as those of `like`."""
    fx, fy, cx, cy, *bend = numbers.tolist()
    changes = {"fx_px": fx, "fy_px": fy, "cx_px": cx + 0.5, "cy_px": cy + 0.5}
    return like.model_copy(update={**changes, "distortion": (*bend, *like.distortion[4:])})


def _information(board: Board, views: Sequence[View], lens: Intrinsics) -> FloatArray:
    """(8, 8) of noise of 1 px: what is left once every view has found its own pose."""
    total = np.zeros((8, 8))
    for view in views:
        pose = board_pose(board, view, lens)
        turn, _ = cv2.Rodrigues(pose[:3, :3])
        points = board.points_m[view.ids]
        slopes = cv2.projectPoints(points, turn, pose[:3, 3], lens.matrix, distortion_of(lens))[1]
        by_pose, by_lens = slopes[:, :6], slopes[:, 6:14]
        bound = by_pose @ np.linalg.solve(by_pose.T @ by_pose, by_pose.T @ by_lens)
        total += by_lens.T @ (by_lens - bound)
    return total


def distortion_of(lens: Intrinsics) -> FloatArray:
    """(5,) k1, k2, p1, p2, k3."""
    return np.array([*lens.distortion, *[0.0] * (5 - len(lens.distortion))])


def board_pose(board: Board, view: View, lens: Intrinsics) -> FloatArray:
    """Pose (4, 4) of the board in the camera's optical frame, by one image alone."""
    found, turn, place = cv2.solvePnP(
        board.points_m[view.ids],
        view.pixels,
        lens.matrix,
        distortion_of(lens),
        flags=cv2.SOLVEPNP_IPPE,
    )
    if not found:
        raise CalibrationError("the board has no pose in an image: its corners are in one line")
    turn, place = cv2.solvePnPRefineLM(
        board.points_m[view.ids], view.pixels, lens.matrix, distortion_of(lens), turn, place
    )
    return placed(cv2.Rodrigues(turn)[0], place.ravel())
