"""How near calibrations come to the truth: random cameras, places, boards and noise.

``python -m vla_zenoh_calibrate.accuracy`` prints the errors of 50 set-ups, projected without
rendering: 25 views each, 0.3 px noise in each coordinate of a corner, and in each pose of the arm
what 0.1 mrad noise in each joint of a Panda at home makes.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import cv2
import numpy as np

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import angle_between, exp3
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.profile import load_profile
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.board import Board, Corners
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.hand_eye import EYES, Eye, calibrate_hand_eye
from vla_zenoh_calibrate.lens import calibrate_lens, distortion_of
from vla_zenoh_calibrate.view import View, inverse, placed

SIZES = ((640, 480), (1280, 720))
MIN_SEEN = 0.5
"""Of the corners of a board in a view."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a corner's coordinates, and of the arm's joints."""

    pixel_px: float = 0.3
    joint_rad: float = 1e-4


@dataclass(frozen=True, eq=False)
class SetUp:
    """A camera, where it is, the board, and views of it with noise.

    Args:
        camera, fixed: X and Z of `hand_eye`.
    """

    lens: Intrinsics
    eye: Eye
    board: Board
    camera: FloatArray
    fixed: FloatArray
    views: list[View]

    @property
    def size(self) -> tuple[int, int]:
        return self.lens.width, self.lens.height


@dataclass(frozen=True)
class Errors:
    """Distances of a calibration from the truth, and the uncertainty that it gives itself."""

    off_m: float
    off_rad: float
    focal_share: float
    spread_m: float
    spread_rad: float
    rms_px: float


def random_lens(random: np.random.Generator) -> Intrinsics:
    """Of a camera of 45 to 80 degrees across, with a little distortion."""
    width, height = SIZES[random.integers(len(SIZES))]
    focal = width / 2 / np.tan(np.radians(random.uniform(45, 80)) / 2)
    return Intrinsics(
        width=width,
        height=height,
        fx_px=float(focal),
        fy_px=float(focal * random.uniform(0.99, 1.01)),
        cx_px=float(width * random.uniform(0.47, 0.53)),
        cy_px=float(height * random.uniform(0.47, 0.53)),
        distortion=tuple(random.normal(0, (0.08, 0.05, 0.001, 0.001)).tolist()),
    )


def look(random: np.random.Generator, lens: Intrinsics, board: Board) -> FloatArray:
    """A pose (4, 4) of the board in the camera, as a person shows it: near, tilted, anywhere."""
    width, height = board.size_m
    # Near enough to fill a third to the whole of the image.
    full_m = max(width * lens.fx_px / lens.width, height * lens.fy_px / lens.height)
    away_m = full_m * random.uniform(1.1, 2.2)
    across = (random.uniform(0.25, 0.75, 2) - 0.5) * (lens.width, lens.height)
    middle = np.array([*(across / (lens.fx_px, lens.fy_px)), 1.0]) * away_m
    tilt, way = random.uniform(0, np.radians(45)), random.uniform(0, 2 * np.pi)
    turn = exp3(tilt * np.array([np.cos(way), np.sin(way), 0.0]))
    turn = turn @ exp3(np.array([0.0, 0.0, random.uniform(-2.5, 2.5)]))
    return placed(turn, middle - turn @ np.array([width / 2, height / 2, 0.0]))


def project(lens: Intrinsics, board: Board, pose: FloatArray) -> Corners:
    """The corners of a board at a pose in the camera that are inside the image."""
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    pixels, _ = cv2.projectPoints(
        board.points_m, rotation, pose[:3, 3], lens.matrix, distortion_of(lens)
    )
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    inside = ((pixels > 1) & (pixels < np.array([lens.width, lens.height]) - 2)).all(axis=1)
    ids = np.nonzero(inside)[0].astype(np.int32)
    return Corners(ids, pixels[ids], 1.5)


def set_up(seed: int, eye: Eye, views: int = 25, noise: Noise | None = None) -> SetUp:
    """A random set-up; the same for the same seed."""
    random = np.random.default_rng(seed)
    amount = noise or Noise()
    board, lens = Board(), random_lens(random)
    far_m = 0.12 if eye == "in-hand" else 1.0
    camera = placed(exp3(random.normal(0, 1.2, 3)), random.normal(0, far_m, 3))
    fixed = placed(exp3(random.normal(0, 1.2, 3)), random.normal(0, 0.5, 3))
    profile = load_profile("panda_sim")
    kinematics = make_kinematics(profile)
    home = kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)
    jacobian = kinematics.jacobian(home)
    found: list[View] = []
    while len(found) < views:
        seen = look(random, lens, board)
        corners = project(lens, board, seen)
        if len(corners.ids) < MIN_SEEN * len(board.points_m):
            continue
        carried = camera @ seen @ inverse(fixed)  # C = X^-1 G Z
        arm = inverse(carried) if eye == "in-hand" else carried
        twist = jacobian @ random.normal(0, amount.joint_rad, len(home))
        arm = placed(exp3(twist[3:]) @ arm[:3, :3], arm[:3, 3] + twist[:3])
        pixels = corners.pixels + random.normal(0, amount.pixel_px, corners.pixels.shape)
        found.append(View(Corners(corners.ids, pixels, corners.edge_px), arm, len(found)))
    return SetUp(lens, eye, board, camera, fixed, found)


def errors_of(made: SetUp) -> Errors:
    """Calibrate lens and place, and compare both with the truth."""
    lens = calibrate_lens(made.board, made.views, made.size)
    found = calibrate_hand_eye(
        made.board, made.views, lens.intrinsics, made.eye, information=lens.information
    )
    apart = inverse(made.camera) @ found.camera
    return Errors(
        off_m=float(np.linalg.norm(apart[:3, 3])),
        off_rad=angle_between(apart[:3, :3], np.eye(3)),
        focal_share=abs(found.lens.fx_px / made.lens.fx_px - 1.0),
        spread_m=found.spread_m,
        spread_rad=found.spread_rad,
        rms_px=found.rms_px,
    )


def main() -> None:
    """Print a line for each set-up and the distribution."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--set-ups", type=int, default=50)
    asked.add_argument("--views", type=int, default=25)
    asked.add_argument("--quiet", action="store_true", help="only the distribution")
    given = asked.parse_args()
    rows: list[Errors] = []
    for seed in range(given.set_ups):
        eye = EYES[seed % 2]
        try:
            one = errors_of(set_up(seed, eye, given.views))
        except CalibrationError as error:
            print(f"{seed:3}  {eye}  refused: {error}")
            continue
        rows.append(one)
        if not given.quiet:
            print(
                f"{seed:3}  {eye}  {one.off_m * 1e3:.3f} mm  {one.off_rad * 1e3:.3f} mrad  focal "
                f"{one.focal_share * 100:.3f} %  own spread {one.spread_m * 1e3:.3f} mm "
                f"{one.spread_rad * 1e3:.3f} mrad  {one.rms_px:.2f} px"
            )
    for name, factor, unit in (("off_m", 1e3, "mm"), ("off_rad", 1e3, "mrad")):
        values = np.array([getattr(one, name) for one in rows]) * factor
        low, high, worst = np.percentile(values, (50, 95, 100))
        print(f"{len(rows)} set-ups: median {low:.3f}, 95 % {high:.3f}, worst {worst:.3f} {unit}")


if __name__ == "__main__":
    main()
