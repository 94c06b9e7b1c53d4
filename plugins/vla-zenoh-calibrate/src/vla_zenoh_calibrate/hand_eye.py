"""Where a camera is on an arm, or beside it: hand-eye calibration.

Poses are (4, 4); ``A_B`` is the pose of B in A. Of view i the arm measures ``base_hand_i``, where
hand is the link at the end of the arm, and the image alone gives ``C_i = camera_board_i``. Two
poses stay the same in all views::

    eye in hand:  X = hand_camera   Z = base_board   base_hand_i X C_i = Z
    eye to hand:  X = base_camera   Z = hand_board   X C_i = base_hand_i Z

Both are ``C_i = X^-1 G_i Z``, with ``G_i = base_hand_i^-1`` for the eye in the hand and
``G_i = base_hand_i`` for the other. Z falls out of two views i and j::

    C_i C_j^-1 = X^-1 (G_i G_j^-1) X,   with A = G_i G_j^-1 and B = C_i C_j^-1:   A X = X B

Rotation: ``R_A R_X = R_X R_B`` says that R_X turns the axis of B into that of A,
``log(R_A) = R_X log(R_B)``: the best one over all pairs by a singular value decomposition. Views
that all turn about one axis leave the turn about it, and the shift along it, open.
Translation: ``(R_A - 1) t_X = R_X t_B - t_A``, linear in t_X over all pairs.

That weighs all pairs alike, whatever an image says of a pose. So X and Z are then improved together
until the corners of all views are nearest to where they were seen (Gauss-Newton, distances in
pixels), with the measured poses of the arm as they are.

A lens that the same views gave is improved with them: an error of 1 px in the principal point turns
X by 2 mrad, and the arm's motion shows it. The cost is ``sum |r|^2 / s^2 + d' W d``, with the
distances r of the corners, their size s before that, the change d of the lens and the inverse
covariance W that its own calibration gives. The less arm and images agree, the larger is s, and the
more the lens stays as it was: an inaccurate arm does not spoil it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, NamedTuple

import cv2
import numpy as np

from vla_zenoh.kinematics.so3 import angle_between, exp3, log3
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.board import Board
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.lens import (
    MIN_NOISE_PX,
    board_pose,
    distortion_of,
    lens_of,
    numbers_of,
)
from vla_zenoh_calibrate.view import MIN_TURN_RAD, View, inverse, placed, turns

Eye = Literal["in-hand", "to-hand"]
EYES: tuple[Eye, Eye] = ("in-hand", "to-hand")
MIN_VIEWS = 6
ALIKE_M, ALIKE_RAD = 0.005, 0.02
ITERATIONS, STEP, SMALL = 30, 1e-6, 1e-9
MAX_SCALE = 0.01
"""How far a square may be from the size that was given, by the arm's motion, as a share."""
BETTER = 0.6
"""Share of the distances of corners that is left with squares of that size, where it is true."""
MAX_OFF_M, MAX_OFF_RAD = 0.01, 0.035
"""Between the board by the image and by the arm (rms): more is no calibration."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera's place.

    Args:
        eye: ``in-hand``: on the arm's last link; ``to-hand``: fixed in the base.
        camera: X, (4, 4) pose of the optical frame in the hand, or in the base.
        board: Z, (4, 4) pose of the board in the base, or in the hand.
        lens: with which they fit best.
        rms_px, worst_px: of the corners, of all and of the worst view (rms).
        rms_m, rms_rad: distance of the board by each image alone from where the arm puts it.
        worst: number of the worst view, from 0.
        spread_m, spread_rad: standard deviation of X, by leaving out one view at a time.
        square_m: of a square of the board, by the arm's motion alone.
    """

    eye: Eye
    camera: FloatArray
    board: FloatArray
    lens: Intrinsics
    rms_px: float
    worst_px: float
    worst: int
    rms_m: float
    rms_rad: float
    spread_m: float
    spread_rad: float
    square_m: float


def calibrate_hand_eye(
    board: Board,
    views: Sequence[View],
    lens: Intrinsics,
    eye: Eye,
    *,
    information: FloatArray | None = None,
    check: bool = True,
) -> HandEye:
    """Where the camera is, by views that each have a pose of the arm.

    Args:
        information: of a lens that comes from the same views, as `Lens` has it: it is improved,
            too. None: the lens is known.
        check: refuse a result that its own residuals contradict.

    Raises:
        CalibrationError: the views do not determine it, or contradict each other.
    """
    poses = [view.arm for view in views if view.arm is not None]
    if len(poses) < len(views):
        raise CalibrationError("a view has no pose of the arm")
    _require_enough(poses)
    carried = [inverse(pose) if eye == "in-hand" else pose for pose in poses]
    seen = [board_pose(board, view, lens) for view in views]
    camera = _first(carried, seen)
    fixed = _mean([inverse(g) @ camera @ c for g, c in zip(carried, seen, strict=True)])
    problem = _Problem(board, views, lens, carried)
    place = problem.improved(_Place(camera, fixed, numbers_of(lens)))
    scale = problem.scale(place)
    if information is not None:
        problem = problem.with_free_lens(place, information)
        place = problem.improved(place)
    best = lens_of(place.lens, lens)
    residuals = problem.residuals(place)
    each_px = np.array([_rms_px([one]) for one in residuals])
    seen = [board_pose(board, view, best) for view in views]
    apart = [
        inverse(c) @ inverse(place.camera) @ g @ place.fixed
        for g, c in zip(carried, seen, strict=True)
    ]
    off_m = np.array([np.linalg.norm(one[:3, 3]) for one in apart])
    off_rad = np.array([np.linalg.norm(log3(one[:3, :3])) for one in apart])
    spread_m, spread_rad = problem.spread(place)
    found = HandEye(
        eye=eye,
        camera=place.camera,
        board=place.fixed,
        lens=best,
        rms_px=_rms_px(residuals),
        worst_px=float(each_px.max()),
        worst=int(each_px.argmax()),
        rms_m=float(np.sqrt((off_m**2).mean())),
        rms_rad=float(np.sqrt((off_rad**2).mean())),
        spread_m=spread_m,
        spread_rad=spread_rad,
        square_m=board.square_m * scale,
    )
    if check:
        _require_fit(board, views, lens, found)
    return found


def _rms_px(residuals: Sequence[FloatArray]) -> float:
    """Of the distances of corners, whose coordinates (2 k,) are in `residuals`."""
    every = np.concatenate(residuals)
    return float(np.sqrt((every**2).sum() / (len(every) / 2)))


def _require_enough(poses: Sequence[FloatArray]) -> None:
    if len(poses) < MIN_VIEWS:
        raise CalibrationError(
            f"too few views for a camera's place: {len(poses)} of at least {MIN_VIEWS}; 20 are good"
        )
    first = poses[0]
    if all(
        np.linalg.norm(pose[:3, 3] - first[:3, 3]) < ALIKE_M
        and angle_between(pose[:3, :3], first[:3, :3]) < ALIKE_RAD
        for pose in poses
    ):
        raise CalibrationError("all views are alike: the arm was at one pose in each; move it")
    turned = turns(poses)
    if turned.rms_rad[0] < MIN_TURN_RAD:
        raise CalibrationError(
            f"the arm hardly turned: {np.degrees(turned.rms_rad[0]):.1f} degrees (rms); a camera's "
            "place needs turns of 20 degrees and more about two axes"
        )
    if turned.rms_rad[1] < MIN_TURN_RAD:
        axis = ", ".join(f"{value:.2f}" for value in turned.axes[0])
        raise CalibrationError(
            f"the arm turned about one axis only, ({axis}) in the base: that leaves the camera's "
            "turn about it and its shift along it open; turn it about another axis as well"
        )


def _require_fit(board: Board, views: Sequence[View], lens: Intrinsics, found: HandEye) -> None:
    scale = found.square_m / board.square_m
    if MAX_SCALE < abs(scale - 1.0) < 0.5:
        sizes = {"square_m": scale * board.square_m, "marker_m": scale * board.marker_m}
        printed = replace(board, **sizes)
        fits = calibrate_hand_eye(printed, views, lens, found.eye, check=False)
        # Only where the views say it clearly.
        if fits.rms_px < BETTER * found.rms_px:
            raise CalibrationError(
                f"by the arm's motion a square of the board is {found.square_m * 1e3:.1f} mm, and "
                f"{board.square_m * 1e3:g} mm was given: measure it, printers scale"
            )
    if found.rms_m < MAX_OFF_M and found.rms_rad < MAX_OFF_RAD:
        return
    other: Eye = "to-hand" if found.eye == "in-hand" else "in-hand"
    turned = calibrate_hand_eye(board, views, lens, other, check=False)
    hint = "did the board or the camera slip, or does another arm's state come?"
    if turned.rms_m < MAX_OFF_M and turned.rms_rad < MAX_OFF_RAD:
        hint = f"with {other} they agree to {turned.rms_m * 1e3:.1f} mm"
    raise CalibrationError(
        f"images and arm contradict each other by {found.rms_m * 1e3:.0f} mm and "
        f"{np.degrees(found.rms_rad):.1f} degrees (rms) for a camera {found.eye}: {hint}"
    )


def _first(carried: Sequence[FloatArray], seen: Sequence[FloatArray]) -> FloatArray:
    """X by A X = X B over all pairs."""
    pairs = list(combinations(range(len(seen)), 2))
    ours = [carried[i] @ inverse(carried[j]) for i, j in pairs]
    theirs = [seen[i] @ inverse(seen[j]) for i, j in pairs]
    by_arm = np.array([log3(pose[:3, :3]) for pose in ours])
    by_eye = np.array([log3(pose[:3, :3]) for pose in theirs])
    left, _, right = np.linalg.svd(by_arm.T @ by_eye)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    turned = np.vstack([pose[:3, :3] - np.eye(3) for pose in ours])
    moved = np.concatenate([rotation @ pose[:3, 3] for pose in theirs])
    shift = np.concatenate([pose[:3, 3] for pose in ours])
    return placed(rotation, np.linalg.lstsq(turned, moved - shift, rcond=None)[0])


def _mean(poses: Sequence[FloatArray]) -> FloatArray:
    """A pose near all of them, to begin with."""
    left, _, right = np.linalg.svd(sum(pose[:3, :3] for pose in poses))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return placed(rotation, np.mean([pose[:3, 3] for pose in poses], axis=0))


class _Place(NamedTuple):
    """X, Z and the numbers of the lens."""

    camera: FloatArray
    fixed: FloatArray
    lens: FloatArray

    def moved(self, step: FloatArray) -> _Place:
        """Changed by two twists (6,), and by eight numbers of the lens if `step` has them."""
        lens = self.lens + step[12:] if len(step) > 12 else self.lens
        return _Place(_moved(self.camera, step[:6]), _moved(self.fixed, step[6:12]), lens)


class _Problem:
    """The distances of all corners as a function of X, Z and the lens.

    Args:
        prior: (8, 8) W times s^2 of the module's cost; None: the lens is known.
        usual: (8,) the lens that `prior` is about.
    """

    def __init__(
        self,
        board: Board,
        views: Sequence[View],
        lens: Intrinsics,
        carried: Sequence[FloatArray],
        prior: FloatArray | None = None,
        usual: FloatArray | None = None,
    ) -> None:
        self._made = board, views, lens, carried
        self._points = [board.points_m[view.ids] for view in views]
        self._pixels = [view.pixels for view in views]
        self._carried = carried
        self._bend = distortion_of(lens)
        self._free = 12 if prior is None else 20
        self._prior = np.zeros((self._free, self._free))
        self._usual = numbers_of(lens) if usual is None else usual
        if prior is not None:
            self._prior[12:, 12:] = prior

    def with_free_lens(self, place: _Place, information: FloatArray) -> _Problem:
        """The same, in which the lens may change; `place`: the best with the lens as it is."""
        noise_px = max(_rms_px(self.residuals(place)) / np.sqrt(2), MIN_NOISE_PX)
        return _Problem(*self._made, information * noise_px**2, place.lens)

    def residuals(self, place: _Place, scale: float = 1.0) -> list[FloatArray]:
        """Of each view (2 k,) pixels, with a board that is `scale` times as large."""
        back = inverse(place.camera)
        fx, fy, cx, cy = place.lens[:4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        bend = np.append(place.lens[4:], self._bend[4:])
        out: list[FloatArray] = []
        for points, pixels, carried in zip(self._points, self._pixels, self._carried, strict=True):
            pose = back @ carried @ place.fixed
            seen, _ = cv2.projectPoints(
                scale * points, log3(pose[:3, :3]), pose[:3, 3], matrix, bend
            )
            out.append((np.asarray(seen).reshape(-1, 2) - pixels).ravel())
        return out

    def improved(self, place: _Place) -> _Place:
        """The place with the least cost, by Gauss-Newton damped where it would get worse."""
        damping = 1e-6
        cost = self._cost(place)
        for _ in range(ITERATIONS):
            slopes, residuals = self._slopes(place)
            slope, residual = np.vstack(slopes), np.concatenate(residuals)
            normal = slope.T @ slope + self._prior
            downhill = slope.T @ residual + self._prior @ self._away(place)
            damped = normal + damping * np.diag(np.diag(normal))
            better = place.moved(np.asarray(-np.linalg.solve(damped, downhill), np.float64))
            new = self._cost(better)
            if new > cost:
                damping *= 10
                continue
            gained, cost, place = cost - new, new, better
            damping = max(damping / 10, 1e-9)
            if gained < SMALL * cost:
                break
        return place

    def spread(self, place: _Place) -> tuple[float, float]:
        """Standard deviations (m, rad) of X by the jackknife, each left-out solution to first
        order: ``(sum_j J_j' J_j) d_i = J_i' r_i`` over all views j but i."""
        slopes, residuals = self._slopes(place)
        normals = [slope.T @ slope for slope in slopes]
        total = sum(normals) + self._prior
        count = len(slopes)
        moves = np.array(
            [
                np.linalg.solve(total - normal, slope.T @ residual)
                for normal, slope, residual in zip(normals, slopes, residuals, strict=True)
            ]
        )
        moves -= moves.mean(axis=0)
        variance = (count - 1) / count * (moves**2).sum(axis=0)
        return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:6].sum()))

    def scale(self, place: _Place) -> float:
        """How many times as large the board looks by the arm's motion, to first order."""
        slopes, residuals = self._slopes(place)
        larger = np.concatenate(self.residuals(place, 1.0 + STEP))
        residual = np.concatenate(residuals)
        slope = np.column_stack([np.vstack(slopes), (larger - residual) / STEP])
        return 1.0 - float(np.linalg.lstsq(slope, residual, rcond=None)[0][-1])

    def _away(self, place: _Place) -> FloatArray:
        """How far the lens is from the usual one, behind twelve zeros."""
        away = np.zeros(self._free)
        away[12:] = (place.lens - self._usual)[: self._free - 12]
        return away

    def _cost(self, place: _Place) -> float:
        away = self._away(place)
        corners = sum(float(one @ one) for one in self.residuals(place))
        return corners + float(away @ self._prior @ away)

    def _slopes(self, place: _Place) -> tuple[list[FloatArray], list[FloatArray]]:
        """Of each view the derivatives (2 k, 12 or 20), and the residuals."""
        now = self.residuals(place)
        columns: list[list[FloatArray]] = []
        for step in np.eye(self._free) * STEP:
            there = self.residuals(place.moved(step))
            columns.append([(new - old) / STEP for new, old in zip(there, now, strict=True)])
        slopes = [np.column_stack(one) for one in zip(*columns, strict=True)]
        return slopes, now


def _moved(pose: FloatArray, twist: FloatArray) -> FloatArray:
    """`pose` shifted (m) and turned (rad) in its parent's axes."""
    return placed(exp3(twist[3:]) @ pose[:3, :3], pose[:3, 3] + twist[:3])
