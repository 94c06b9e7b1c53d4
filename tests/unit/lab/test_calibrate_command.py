"""``vla-zenoh camera board`` and ``camera calibrate`` with a recording, and what is written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result
from vla_zenoh_calibrate.accuracy import project
from vla_zenoh_calibrate.board import Board
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.profile_edit import with_keys, write_profile
from vla_zenoh_calibrate.result import rpy_of
from vla_zenoh_calibrate.tour import read_joints, tour
from vla_zenoh_calibrate.view import inverse, placed

from vla_zenoh.codec import records
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import exp3, rotation_from_rpy
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.nodes.camera.geometry import Intrinsics, read_intrinsics
from vla_zenoh.profile import load_profile, to_yaml
from vla_zenoh.program.main import app
from vla_zenoh.types import FloatArray, Header, JointState

BOARD = Board()
WIDTH, HEIGHT, FOCAL_PX = 640, 480, 520.0
LENS = Intrinsics(width=WIDTH, height=HEIGHT, fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=318, cy_px=243)
CAMERA = placed(exp3(np.array([0.1, -0.2, 1.5])), np.array([0.06, 0.01, -0.08]))
"""In the TCP: it looks along its z, as the TCP's."""
VIEWS = 16
LONG = pytest.mark.long
ZERO_NS = 1_700_000_000_000_000_000
PROFILE = """\
# of our lab
extends: panda_sim
cameras:
  wrist:  # on the hand
    source: "v4l2:0"
    rate_hz: 15
  front: {source: "v4l2:1"}
"""


def drawn(pose: FloatArray) -> np.ndarray:
    """The board at a pose in the camera, RGB."""
    per_square, margin = 60, 0.5
    paper = BOARD.image(per_square, margin)
    m_per_px = BOARD.square_m / per_square
    shift = margin * BOARD.square_m
    # A pixel's centre is half a pixel behind its corner.
    flat = np.array(
        [[m_per_px, 0, m_per_px / 2 - shift], [0, m_per_px, m_per_px / 2 - shift], [0, 0, 1]]
    )
    plane = LENS.matrix @ np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]) @ flat
    grey = cv2.warpPerspective(
        cv2.GaussianBlur(paper, (0, 0), 1.0),
        plane,
        (WIDTH, HEIGHT),
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=140.0,
    )
    return np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a profile and a recording of an arm with a camera in its hand."""
    folder = tmp_path_factory.mktemp("calibrate")
    file = folder / "lab.yaml"
    file.write_text(PROFILE)
    profile = load_profile(str(file))
    kinematics, keys = make_kinematics(profile), profile.keys
    home = kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)

    def tcp(joints: FloatArray) -> FloatArray:
        pose = kinematics.forward(joints)
        return placed(pose.rotation, pose.position_m)

    middle = np.array([BOARD.size_m[0] / 2, BOARD.size_m[1] / 2, 0.0])
    board = tcp(home) @ CAMERA @ placed(np.eye(3), np.array([0.0, 0.0, 0.4]) - middle)
    random = np.random.default_rng(1)
    out = RecordingWriter(
        folder / "run.mcap", keys, profile_yaml=to_yaml(profile), base_frame="b", began_ns=ZERO_NS
    )
    done, seq = 0, 0
    while done < VIEWS:
        joints = home + random.uniform(-1, 1, 7) * [0.1, 0.12, 0.1, 0.12, 0.45, 0.45, 1.0]
        pose = inverse(tcp(joints) @ CAMERA) @ board
        if len(project(LENS, BOARD, pose).ids) < 30:
            continue
        done += 1
        at_ns = ZERO_NS + done * 2_000_000_000
        for shift in range(-10, 11):
            stamp_ns, seq = at_ns + shift * 50_000_000, seq + 1
            noisy = joints + random.normal(0, 1e-4, 7)
            state = JointState(kinematics.arm_joints, noisy, np.zeros(7), None)
            header = Header(stamp_ns, seq, "robot-1")
            payload = records.encode(state)
            out.write(Sample(keys.state_joint, payload, MSGPACK, header, stamp_ns))
            if shift == 0:
                image = drawn(pose).astype(float) + random.normal(0, 3.0, (HEIGHT, WIDTH, 1))
                jpeg = cv2.imencode(".jpg", image.clip(0, 255).astype(np.uint8))[1].tobytes()
                header = Header(stamp_ns, done, "camera-1")
                key = keys.camera_jpeg("wrist")
                out.write(Sample(key, jpeg, JPEG, header, stamp_ns + 10_000_000))
    out.finish()
    return folder


@pytest.fixture(autouse=True, scope="module")
def found_once() -> Iterator[None]:
    """The board in each image of the recording, which many tests read."""
    find, found = Board.find, dict[tuple[Board, bytes], Any]()

    def remembered(board: Board, grey: Any) -> Any:
        asked = board, grey.tobytes()
        if asked not in found:
            found[asked] = find(board, grey)
        return found[asked]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Board, "find", remembered)
        yield


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["camera", *map(str, words)])


def calibrate(rig: Path, *words: object) -> Result:
    return run("calibrate", "wrist", "--recording", rig / "run.mcap", *words)


def why(found: Result) -> str:
    assert found.exit_code != 0
    return str(found.exception) + found.output


def test_a_camera_in_the_hand_is_calibrated_and_written(rig: Path, tmp_path: Path) -> None:
    mine = tmp_path / "lab.yaml"
    mine.write_text(PROFILE)
    out = tmp_path / "out"
    found = calibrate(rig, "--eye", "in-hand", "-o", out, "--write", mine, "--json")
    assert found.exit_code == 0, why(found)
    report = json.loads(found.stdout)
    assert report["views"] == VIEWS
    assert report["place"]["rms_px"] < 0.5
    assert report["place"]["spread_m"] < 1e-3
    assert report["place"]["square_m"] == pytest.approx(0.03, rel=5e-3)
    text = mine.read_text()
    assert "# of our lab" in text
    assert "# on the hand" in text
    assert (tmp_path / "lab.yaml.1.bak").read_text() == PROFILE
    camera = load_profile(str(mine)).cameras["wrist"]
    assert camera.rate_hz == 15
    mount = camera.mount
    assert mount is not None
    assert (mount.link, mount.frame) == ("panda_hand_tcp", "wrist_optical_frame")
    assert np.linalg.norm(np.array(mount.position_m) - CAMERA[:3, 3]) < 1.5e-3
    turned = rotation_from_rpy(np.array(mount.rpy_rad))
    assert np.linalg.norm(cv2.Rodrigues(turned.T @ CAMERA[:3, :3])[0]) < 4e-3
    assert camera.intrinsics is not None
    lens = read_intrinsics(Path(camera.intrinsics))
    assert lens.fx_px == pytest.approx(FOCAL_PX, rel=5e-3)
    assert (lens.width, lens.height) == (WIDTH, HEIGHT)
    fragment = yaml.safe_load((out / "profile.yaml").read_text())
    assert set(fragment["cameras"]["wrist"]) == {"intrinsics", "mount"}
    assert cv2.imread(str(out / "frames.jpg")) is not None
    assert "cameras.wrist.mount is set" in found.stderr


def test_a_known_lens_is_kept_and_another_link_may_carry_the_camera(
    rig: Path, tmp_path: Path
) -> None:
    lens = tmp_path / "lens.yaml"
    double = LENS.scaled(2 * WIDTH, 2 * HEIGHT)
    lens.write_text(yaml.safe_dump(double.model_dump(mode="json")))
    words = ("--eye", "in-hand", "--lens", lens, "--link", "panda_hand", "--json")
    found = calibrate(rig, *words, "-o", tmp_path / "out")
    assert found.exit_code == 0, why(found)
    keys = json.loads(found.stdout)["profile"]["cameras"]["wrist"]
    assert set(keys) == {"mount"}
    # The TCP of this hand is 0.1034 m ahead of it, without a turn.
    expected = CAMERA[:3, 3] + [0, 0, 0.1034]
    assert np.linalg.norm(np.array(keys["mount"]["position_m"]) - expected) < 1e-3


def test_the_lens_alone_needs_no_arm(rig: Path, tmp_path: Path) -> None:
    found = calibrate(rig, "-o", tmp_path / "out")
    # One image at each place: without an arm nothing says that the board stood.
    assert "moving" in why(found)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--eye", "in-hand", "--link", "panda_hnad"], "did you mean 'panda_hand'"),
        (["--eye", "in-hand", "--link", "panda_link3"], "moves against panda_hand_tcp"),
        (["--eye", "to-hand", "--link", "panda_hand"], "moves against panda_link0"),
        (["--eye", "in-hand", "--keep-lens"], "reports no lens"),
        (["--eye", "in-hand", "--part", "left"], "name one with --part"),
        pytest.param(["--eye", "in-hand", "--dictionary", "6X6_100"], "markers of 5X5", marks=LONG),
        pytest.param(["--eye", "in-hand", "--squares", "7x5"], "board has 0 to 16", marks=LONG),
        (["--eye", "in-hand", "--squares", "9"], "wants COLUMNSxROWS"),
        (["--eye", "in-hand", "--square-m", "0.0285"], "measure it"),
        (["--eye", "to-hand"], "with in-hand they agree"),
        (["--eye", "on-hand"], "in-hand or to-hand"),
        (["--keep-lens"], "nothing is left to calibrate"),
        (["--tour"], "needs --eye"),
        (["--eye", "in-hand", "--pose-state"], "stale"),
    ],
)
def test_what_cannot_be_calibrated_is_named(
    rig: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    found = calibrate(rig, *words, "-o", tmp_path / "out")
    assert said in why(found)
    assert not (tmp_path / "out").exists()


def test_a_lens_of_images_of_another_shape_is_refused(rig: Path, tmp_path: Path) -> None:
    lens = tmp_path / "lens.yaml"
    lens.write_text(yaml.safe_dump(LENS.scaled(1280, 720).model_dump(mode="json")))
    found = calibrate(rig, "--eye", "in-hand", "--lens", lens, "-o", tmp_path / "out")
    assert "of images of 1280x720" in why(found)


def test_a_camera_that_is_not_there_is_named(rig: Path, tmp_path: Path) -> None:
    found = run("calibrate", "wirst", "-r", rig / "run.mcap", "-o", tmp_path / "out")
    assert "did you mean 'wrist'" in why(found)
    found = run("calibrate", "front", "-r", rig / "run.mcap", "-o", tmp_path / "out")
    assert "no images of camera 'front'" in why(found)


def test_a_profile_that_cannot_take_it_stays_as_it_was(rig: Path, tmp_path: Path) -> None:
    found = calibrate(
        rig, "--eye", "in-hand", "-o", tmp_path / "out", "--write", tmp_path / "none.yaml"
    )
    assert "is no file" in why(found)
    mine = tmp_path / "lab.yaml"
    mine.write_text(PROFILE.replace("wrist:", "elbow:"))
    with pytest.raises(CalibrationError, match="would be wrong"):
        write_profile(mine, ("cameras", "wrist"), {"intrinsics": 7})
    assert mine.read_text() == PROFILE.replace("wrist:", "elbow:")
    assert sorted(path.name for path in tmp_path.glob("lab*")) == ["lab.yaml"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: 1\n",
        "a: 1  # one\n# end\n",
        "cameras:\n",
        "cameras: {}\n",
        "cameras: {wrist: {source: x}}\nb: 2\n",
        "cameras: {wrist: {source: x, }, }\n",
        "cameras:\n  front: {source: y}\n# behind\nb: 2\n",
        "cameras:\n  wrist:\n    source: x\n  # between\n  front: {source: y}\n",
        "cameras:\n  wrist:\n    mount:\n      link: a\n      # why\n    s: x # keep\nb: [1]\n",
        "cameras:\n    wrist:\n        intrinsics: old.yaml\n        mount: {link: a}\n",
        "cameras:\n  wrist: null\n  front: {}",
        "{cameras: {front: {}}}",
        "cameras:\n  wrist:\n    source: |\n      x\n    list:\n    - 1\n    - 2\nc: 3\n",
    ],
)
def test_keys_are_set_in_any_form_and_the_rest_stays(text: str) -> None:
    values = {"intrinsics": "lens.yaml", "mount": {"frame": "e", "position_m": [0.1, -2e-06, 3.0]}}
    changed = with_keys(text, ("cameras", "wrist"), values)
    before, after = yaml.safe_load(text) or {}, yaml.safe_load(changed)
    cameras = before.get("cameras") or {}
    wrist = {**(cameras.get("wrist") or {}), **values}
    assert after == {**before, "cameras": {**cameras, "wrist": wrist}}
    for comment in (word for word in ("# one", "# end", "# behind", "# between", "# keep")):
        assert (comment in text) == (comment in changed)
    assert with_keys(changed, ("cameras", "wrist"), values) == changed


@pytest.mark.parametrize("text", ["cameras: [1]\n", "cameras: {wrist: 3}\n", "[]"])
def test_a_profile_of_another_form_is_not_changed(text: str) -> None:
    with pytest.raises(CalibrationError, match="is no map"):
        with_keys(text, ("cameras", "wrist"), {"intrinsics": "a"})


def test_the_board_is_written_with_what_to_measure(tmp_path: Path) -> None:
    found = run("board", "-o", tmp_path / "b.png", "--squares", "7x5", "--square-m", "0.04")
    assert found.exit_code == 0
    assert "40 mm" in found.output
    found = run("board", "-o", tmp_path / "b.txt")
    assert ".pdf or .png" in why(found)


def test_angles_and_rotations_are_inverse() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        rotation = exp3(random.normal(0, 1.5, 3))
        assert np.allclose(rotation_from_rpy(np.array(rpy_of(rotation))), rotation, atol=1e-12)
    for pitch in (np.pi / 2, -np.pi / 2):
        rotation = rotation_from_rpy(np.array([0.4, pitch, -0.7]))
        assert np.allclose(rotation_from_rpy(np.array(rpy_of(rotation))), rotation, atol=1e-9)


def test_a_tour_turns_about_two_axes_and_stays_near() -> None:
    start = placed(exp3(np.array([3.0, 0.1, 0.2])), np.array([0.4, 0.0, 0.3]))
    for eye in ("in-hand", "to-hand"):
        poses = tour(start, eye, 0.3, 20)
        assert len(poses) == 20
        for pose in poses:
            assert np.linalg.norm(pose[:3, 3] - start[:3, 3]) < 0.3
            assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("text", ["", "3", "[]", "- [1, 2]", "- [1, a, 3]", "- [1, .nan, 3]", "{"])
def test_a_wrong_file_of_a_tour_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "tour.yaml"
    path.write_text(text)
    with pytest.raises(VlaZenohError, match=r"tour\.yaml"):
        read_joints(path, 3)
    path.write_text("- [0, 1, -2.5]\n")
    assert read_joints(path, 3) == [(0.0, 1.0, -2.5)]
