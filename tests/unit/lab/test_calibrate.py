"""Calibration of a camera: the board, the lens, the camera's place, and which views are taken."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from vla_zenoh_calibrate.accuracy import Noise, SetUp, errors_of, project, set_up
from vla_zenoh_calibrate.board import Board, Corners, Refused
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.hand_eye import EYES, Eye, HandEye, calibrate_hand_eye
from vla_zenoh_calibrate.lens import calibrate_lens
from vla_zenoh_calibrate.sampling import MAX_APART_S, Sampler, Taken
from vla_zenoh_calibrate.view import View, placed

from vla_zenoh.kinematics.so3 import angle_between, exp3
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.types import FloatArray

BOARD = Board()
EXACT = Noise(pixel_px=0.0, joint_rad=0.0)
SIZE = (640, 480)
SECOND_NS = 1_000_000_000


# -- the board ------------------------------------------------------------------------------------
def paper(board: Board = BOARD, per_square: int = 40) -> np.ndarray:
    """A board in the middle of a grey image, (480, 640)."""
    drawn = board.image(per_square, 0.5)
    image = np.full((SIZE[1], SIZE[0]), 128, np.uint8)
    top, left = (SIZE[1] - drawn.shape[0]) // 2, (SIZE[0] - drawn.shape[1]) // 2
    image[top : top + drawn.shape[0], left : left + drawn.shape[1]] = drawn
    return image


def refused(image: np.ndarray, board: Board = BOARD) -> str:
    found = board.find(image)
    assert isinstance(found, Refused)
    return found.reason


def test_corners_are_found_where_they_are_drawn() -> None:
    found = BOARD.find(paper())
    assert isinstance(found, Corners)
    assert found.ids.tolist() == list(range(40))
    origin = (SIZE[0] - 9 * 40) / 2, (SIZE[1] - 6 * 40) / 2
    expected = BOARD.points_m[:, :2] / BOARD.square_m * 40 + origin - 0.5
    assert np.abs(found.pixels - expected).max() < 0.5
    assert found.edge_px < 2.5


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((480, 640), 128, np.uint8), "no_board"),
        (np.where(np.arange(640) < 260, paper(), 128).astype(np.uint8), "partial"),
        (cv2.GaussianBlur(paper(per_square=60), (0, 0), 2.0), "blurred"),
        (cv2.blur(paper(per_square=60), (7, 1)), "blurred"),
    ],
    ids=["empty", "half", "out of focus", "moved"],
)
def test_an_image_that_is_of_no_use_is_refused_by_name(image: np.ndarray, reason: str) -> None:
    assert refused(image) == reason


def test_why_no_board_is_found_is_said() -> None:
    assert "mirrored" in BOARD.why_not(np.ascontiguousarray(paper()[:, ::-1]))
    assert "mirrored" in BOARD.why_not(np.ascontiguousarray(paper()[::-1]))
    other = Board(dictionary="6X6_250")
    assert refused(paper(), other) == "no_board"
    # To look through a thousand numbers of four sizes takes as long as there are markers.
    corner = np.ascontiguousarray(paper()[270:, 330:])
    assert "4 markers of 5X5" in other.why_not(corner)
    smaller = Board(columns=7, rows=5)
    assert refused(paper(), smaller) in ("no_board", "other_board", "partial")
    assert "up to number 26" in smaller.why_not(corner)
    assert "no markers at all" in BOARD.why_not(np.zeros((480, 640), np.uint8))


def test_a_board_upside_down_is_found() -> None:
    assert isinstance(BOARD.find(np.ascontiguousarray(paper()[::-1, ::-1])), Corners)


@pytest.mark.parametrize(
    "wrong",
    [
        {"columns": 2},
        {"rows": 51},
        {"square_m": 0.0},
        {"square_m": float("nan")},
        {"marker_m": 0.03},
        {"marker_m": float("nan")},
        {"dictionary": "8X8_50"},
        {"columns": 20, "rows": 20},
    ],
)
def test_a_board_that_cannot_be_is_rejected(wrong: dict[str, object]) -> None:
    with pytest.raises(CalibrationError):
        replace(BOARD, **wrong)


def test_a_printed_board_has_its_true_size() -> None:
    png = BOARD.png(300)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    place = png.index(b"pHYs") + 4
    per_metre = int.from_bytes(png[place : place + 4], "big")
    found = BOARD.find(np.asarray(image, np.uint8))
    assert isinstance(found, Corners)
    across_m = float(np.ptp(found.pixels[:, 0])) / per_metre
    assert across_m == pytest.approx(7 * 0.03, rel=1e-3)
    pdf = BOARD.pdf()
    points = 9 * 0.03 / 0.0254 * 72
    assert pdf.startswith(b"%PDF")
    assert f"q {points:.4f} 0 0".encode() in pdf
    began = int(pdf.rsplit(b"startxref\n", 1)[1].split()[0])
    assert pdf[began:].startswith(b"xref")


# -- lens and place -------------------------------------------------------------------------------
def calibrated(made: SetUp) -> HandEye:
    return calibrate_hand_eye(made.board, made.views, made.lens, made.eye)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("seed", range(3))
def test_without_noise_the_place_is_exact(seed: int, eye: Eye) -> None:
    made = set_up(seed, eye, views=10, noise=EXACT)
    found = calibrated(made)
    assert np.allclose(found.camera, made.camera, atol=1e-6)
    assert np.allclose(found.board, made.fixed, atol=1e-6)
    assert found.rms_px < 1e-3
    assert found.square_m == pytest.approx(0.03, rel=1e-4)


@pytest.mark.parametrize(("seed", "eye"), [(0, "in-hand"), (1, "to-hand"), (3, "to-hand")])
def test_with_noise_the_errors_are_small_and_the_spread_says_how_small(seed: int, eye: Eye) -> None:
    found = errors_of(set_up(seed, eye))
    assert found.off_m < 0.0015
    assert found.off_rad < 0.005
    assert found.focal_share < 0.003
    assert found.off_m < 5 * found.spread_m
    assert found.off_rad < 5 * found.spread_rad


def test_the_lens_is_found_without_noise() -> None:
    made = set_up(4, "in-hand", noise=EXACT)
    found = calibrate_lens(made.board, made.views, made.size).intrinsics
    assert np.allclose(found.matrix, made.lens.matrix, atol=0.2)
    assert found.distortion[:4] == pytest.approx(made.lens.distortion, abs=5e-3)


def about_one_axis(made: SetUp) -> list[View]:
    """Views with the arm turned about the base's z alone."""
    out: list[View] = []
    first = made.views[0].arm
    assert first is not None
    for turn in np.linspace(-0.6, 0.6, 9):
        arm = placed(exp3(np.array([0.0, 0.0, turn])) @ first[:3, :3], first[:3, 3] + 0.01 * turn)
        out.append(View(made.views[0].corners, arm))
    return out


@pytest.mark.parametrize("eye", EYES)
def test_views_that_leave_the_place_open_are_refused_by_name(eye: Eye) -> None:
    made = set_up(1, eye, views=10, noise=EXACT)

    def why(views: list[View]) -> str:
        with pytest.raises(CalibrationError) as error:
            calibrate_hand_eye(BOARD, views, made.lens, eye)
        return str(error.value)

    assert "too few views" in why(made.views[:5])
    assert "all views are alike" in why([made.views[0]] * 10)
    assert "about one axis only" in why(about_one_axis(made))
    shifted = [
        replace(view, arm=placed(np.eye(3), np.array([0.02 * number, 0.0, 0.0])))
        for number, view in enumerate(made.views)
    ]
    assert "hardly turned" in why(shifted)
    assert "no pose of the arm" in why([replace(made.views[0], arm=None), *made.views])


@pytest.mark.parametrize("eye", EYES)
def test_a_wrong_arrangement_and_a_slipped_board_are_named(eye: Eye) -> None:
    made = set_up(2, eye, views=12, noise=EXACT)
    other: Eye = "to-hand" if eye == "in-hand" else "in-hand"
    with pytest.raises(CalibrationError, match=f"with {eye} they agree"):
        calibrate_hand_eye(BOARD, made.views, made.lens, other)
    slip = placed(np.eye(3), np.array([0.08, 0.0, 0.05]))
    slipped = [
        replace(view, arm=view.arm @ slip if number > 5 and view.arm is not None else view.arm)
        for number, view in enumerate(made.views)
    ]
    with pytest.raises(CalibrationError, match="did the board or the camera slip"):
        calibrate_hand_eye(BOARD, slipped, made.lens, eye)


@pytest.mark.parametrize("square_m", [0.0291, 0.031])
def test_squares_of_another_size_are_noticed(square_m: float) -> None:
    made = set_up(6, "in-hand")
    printed = Board(square_m=square_m, marker_m=0.02)
    with pytest.raises(CalibrationError, match="measure it"):
        calibrate_hand_eye(printed, made.views, made.lens, made.eye)


def test_views_that_leave_the_lens_open_are_refused_by_name() -> None:
    made = set_up(7, "in-hand", noise=EXACT)
    with pytest.raises(CalibrationError, match="too few views for a lens"):
        calibrate_lens(BOARD, made.views[:7], made.size)
    far = [in_view(made.lens, placed(np.eye(3), np.array([-0.1, -0.05, 3.0])))] * 10
    with pytest.raises(CalibrationError, match="in 1 of 9 parts"):
        calibrate_lens(BOARD, far, made.size)
    plain = made.lens.model_copy(update={"distortion": ()})
    away_m = 1.2 * 0.27 * made.lens.fx_px / made.lens.width
    flat = [
        in_view(plain, placed(np.eye(3), np.array([-0.135 + across, -0.09 + down, away_m])))
        for across in (-0.08, 0.0, 0.08)
        for down in (-0.06, 0.0, 0.06)
    ]
    with pytest.raises(CalibrationError, match="straight on"):
        calibrate_lens(BOARD, flat, made.size)


def in_view(lens: Intrinsics, pose: FloatArray) -> View:
    return View(project(lens, BOARD, pose))


# -- which views are taken ------------------------------------------------------------------------
class Shown:
    """A sampler beside what it is shown: a board straight on, and an arm."""

    def __init__(self, *, with_arm: bool = True) -> None:
        self.sampler = Sampler(BOARD, with_arm=with_arm)
        self.colour = np.repeat(paper()[..., None], 3, axis=2)

    def arm(self, at_s: float, place: FloatArray, moves: float = 0.0, late_s: float = 0.0) -> None:
        """States at 20 Hz around a time, on the way if it `moves` (m/s)."""
        for shift in np.arange(-0.5, 0.51, 0.05):
            stamp_ns = int((at_s + shift) * SECOND_NS)
            pose = placed(np.eye(3), place + moves * shift)
            self.sampler.add_state(stamp_ns, pose, stamp_ns + int(late_s * SECOND_NS))

    def image(self, at_s: float, late_s: float = 0.02) -> None:
        stamp_ns = int(at_s * SECOND_NS)
        self.sampler.add_image(stamp_ns, self.colour, stamp_ns + int(late_s * SECOND_NS))

    def settle(self) -> list[str]:
        return ["taken" if isinstance(one, Taken) else one.reason for one in self.sampler.settle()]


def test_a_view_is_taken_while_the_arm_stands_and_only_once_at_a_place() -> None:
    shown = Shown()
    place = np.array([0.4, 0.0, 0.3])
    shown.arm(10.0, place)
    shown.image(10.0)
    assert shown.settle() == ["taken"]
    arm = shown.sampler.views[0].arm
    assert arm is not None
    assert np.allclose(arm[:3, 3], place)
    shown.arm(12.0, place + 0.001)
    shown.image(12.0)
    assert shown.settle() == ["repeated"]
    shown.arm(14.0, place + 0.05, moves=0.02)
    shown.image(14.0)
    assert shown.settle() == ["moving"]
    shown.image(20.0)
    shown.arm(25.0, place)
    assert shown.settle() == ["stale"]


def test_an_image_waits_for_the_states_after_it() -> None:
    shown = Shown()
    shown.arm(9.7, np.zeros(3))
    shown.image(10.0)
    assert shown.settle() == []
    shown.arm(10.3, np.zeros(3))
    assert shown.settle() == ["taken"]


@pytest.mark.parametrize("late_s", [0.5, -0.5])
def test_clocks_that_differ_are_named(late_s: float) -> None:
    shown = Shown()
    shown.arm(10.0, np.zeros(3))
    for number in range(5):
        shown.image(10.0 + 0.01 * number, late_s=0.02 + late_s)
    with pytest.raises(CalibrationError, match="clocks of the two hosts"):
        shown.settle()
    assert abs(late_s) > MAX_APART_S


def test_images_of_two_sizes_are_rejected() -> None:
    shown = Shown()
    shown.image(10.0)
    shown.colour = shown.colour[:240]
    with pytest.raises(CalibrationError, match="one size of picture"):
        shown.image(11.0)


def test_without_an_arm_the_board_itself_must_stand() -> None:
    shown = Shown(with_arm=False)
    shown.image(10.0)
    assert shown.settle() == ["moving"]
    shown.image(10.1)
    assert shown.settle() == ["taken"]
    shown.image(10.2)
    assert shown.settle() == ["repeated"]
    shown.colour = np.roll(shown.colour, 60, axis=1)
    shown.image(10.3)
    shown.image(10.4)
    assert shown.settle() == ["moving", "taken"]


def test_what_is_missing_is_said() -> None:
    shown = Shown()
    shown.arm(10.0, np.zeros(3))
    shown.image(10.0)
    shown.settle()
    said = "; ".join(shown.sampler.missing(25))
    assert "24 more views" in said
    assert "top left" in said
    assert "turns of the arm about two axes" in said


def test_without_a_view_the_reason_is_said() -> None:
    shown = Shown()
    with pytest.raises(CalibrationError, match="no image came"):
        shown.sampler.require_some()
    shown.colour = np.ascontiguousarray(shown.colour[:, ::-1])
    shown.arm(10.0, np.zeros(3))
    shown.image(10.0)
    assert shown.settle() == ["no_board"]
    with pytest.raises(CalibrationError, match="mirrored"):
        shown.sampler.require_some()


def test_a_pose_of_an_arm_is_the_mean_around_the_image() -> None:
    shown = Shown()
    random = np.random.default_rng(0)
    for shift in np.arange(-0.5, 0.51, 0.02):
        stamp_ns = int((10.0 + shift) * SECOND_NS)
        noise = placed(exp3(random.normal(0, 1e-4, 3)), random.normal(0, 5e-5, 3))
        shown.sampler.add_state(stamp_ns, noise, stamp_ns)
    shown.image(10.0)
    assert shown.settle() == ["taken"]
    arm = shown.sampler.views[0].arm
    assert arm is not None
    assert np.linalg.norm(arm[:3, 3]) < 4e-5
    assert angle_between(arm[:3, :3], np.eye(3)) < 8e-5
