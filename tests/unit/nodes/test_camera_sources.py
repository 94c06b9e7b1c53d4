"""Sources of pictures without a bus: pacing, colours, sizes, order, and what errors say."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wrong_profiles import CAMERA_SOURCES

from vla_zenoh.errors import MissingExtraError, NodeError, PluginError
from vla_zenoh.lab.cli.camera import connected_cameras
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.nodes.camera.camera_publisher import EARLY, LATE, RateLimiter, to_rgb
from vla_zenoh.nodes.camera.geometry import resize
from vla_zenoh.nodes.camera.node import choose_cameras, make_source
from vla_zenoh.nodes.camera.opencv_sources import (
    FileSource,
    RtspSource,
    V4l2Source,
    captured_ns,
    natural,
    open_frames,
    why_not,
)
from vla_zenoh.nodes.camera.source import without_password
from vla_zenoh.plugins import CameraPlugin, FoundCamera
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.schema import CameraProfile

SECOND_NS = 1_000_000_000
REFUSAL_S = 0.5  # an address where nothing listens is given up at once
PACE_TOLERANCE_S = 0.03
RED_BGR, RED_RGB = (10, 60, 240), (240, 60, 10)
ELSEWHERE = ("sim", "ros2")
"""Sources that another node opens."""


def passed(pace: RateLimiter, times_ns: list[int]) -> list[int]:
    return [now_ns for now_ns in times_ns if pace.due(now_ns)]


# -- pace -----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("source_hz", "expected_hz"), [(30, 30), (60, 30), (120, 30), (12, 12)])
def test_a_pace_lets_a_steady_source_through_up_to_its_rate(
    source_hz: int, expected_hz: int
) -> None:
    times = [i * SECOND_NS // source_hz for i in range(10 * source_hz)]
    assert len(passed(RateLimiter(30.0), times)) == pytest.approx(10 * expected_hz, abs=1)


def test_every_other_picture_of_a_source_of_nearly_twice_the_rate_goes_out() -> None:
    """The simulator's scene comes every 17 ms; 30 Hz of it has to be even."""
    out = passed(RateLimiter(30.0), [i * 17_000_000 for i in range(1000)])
    assert set(np.diff(out).tolist()) == {34_000_000}


@given(st.lists(st.integers(0, 200_000_000), min_size=2, max_size=200))
def test_two_pictures_never_follow_closer_than_the_pace_allows(gaps_ns: list[int]) -> None:
    out = passed(RateLimiter(20.0), np.cumsum(gaps_ns).tolist())
    closest_ns = (1 - EARLY - LATE) * SECOND_NS / 20
    assert all(gap >= closest_ns - 1 for gap in np.diff(out))


@given(st.lists(st.integers(0, 200_000_000), min_size=2, max_size=200))
def test_the_rate_is_a_maximum_over_any_stretch_of_time(gaps_ns: list[int]) -> None:
    times = np.cumsum(gaps_ns).tolist()
    out = passed(RateLimiter(20.0), times)
    allowed = (times[-1] - times[0]) / SECOND_NS * 20 + 1 + EARLY + LATE
    assert len(out) <= allowed


def test_after_a_stall_there_is_no_burst() -> None:
    pace = RateLimiter(10.0)
    assert pace.due(0)
    backlog = [5 * SECOND_NS + i * 1_000_000 for i in range(20)]
    assert passed(pace, backlog) == backlog[:1]


def test_a_clock_that_was_set_back_does_not_silence_the_camera() -> None:
    pace = RateLimiter(30.0)
    assert pace.due(100 * SECOND_NS)
    assert pace.due(SECOND_NS)


# -- pictures -------------------------------------------------------------------------------------
def test_blue_first_pictures_become_red_first() -> None:
    bgr = np.full((4, 6, 3), RED_BGR, np.uint8)
    assert to_rgb(bgr)[2, 3].tolist() == list(RED_RGB)


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1)])
def test_grey_becomes_three_equal_channels(shape: tuple[int, ...]) -> None:
    rgb = to_rgb(np.full(shape, 77, np.uint8))
    assert rgb.shape == (4, 6, 3)
    assert (rgb == 77).all()


def test_a_fourth_channel_is_dropped() -> None:
    bgra = np.full((4, 6, 4), (*RED_BGR, 128), np.uint8)
    assert to_rgb(bgra)[0, 0].tolist() == list(RED_RGB)


def test_sixteen_bits_keep_their_upper_eight() -> None:
    assert (to_rgb(np.full((4, 6), 0xABCD, np.uint16)) == 0xAB).all()


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 6, 2), np.uint8), np.zeros((4, 6), np.float32), np.zeros(4, np.uint8)]
)
def test_what_is_no_picture_is_refused(picture: np.ndarray) -> None:
    with pytest.raises(NodeError, match="wanted 1, 3 or 4 channels of 8 or 16 bits"):
        to_rgb(picture)


def test_a_larger_picture_is_averaged_not_sampled() -> None:
    board = np.indices((40, 40)).sum(axis=0) % 2 * 255
    assert (resize(board.astype(np.uint8), 20, 20) == 128).all()


def test_a_picture_of_the_right_size_is_left_alone() -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    assert resize(picture, 30, 20) is picture
    assert resize(picture, 60, 50).shape == (50, 60, 3)


# -- files ----------------------------------------------------------------------------------------
def write_grey(folder: Path, *names: str) -> None:
    for level, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), np.full((8, 8, 3), 10 * level, np.uint8))


def test_pictures_come_in_natural_order() -> None:
    names = ["b1.png", "a10.png", "a2.png", "A3.png"]
    assert [path.name for path in sorted(map(Path, names), key=natural)] == [
        "a2.png",
        "A3.png",
        "a10.png",
        "b1.png",
    ]


def test_a_folder_shows_its_pictures_and_skips_other_files(tmp_path: Path) -> None:
    write_grey(tmp_path, "1.png", "2.bmp", "10.jpg")
    (tmp_path / "3.txt").write_text("not a picture")
    (tmp_path / "4.png").mkdir()
    levels = []
    for decode in open_frames(tmp_path).images:
        picture = decode()
        assert picture is not None
        levels.append(int(picture[4, 4, 0]))
    assert levels == [0, 10, 20]


def test_a_single_picture_can_be_shown_for_ever(tmp_path: Path) -> None:
    write_grey(tmp_path, "0.png", "still.png")
    source = FileSource(str(tmp_path / "still.png"), rate_hz=200.0)
    source.open()
    for _ in range(5):
        assert source.grab(threading.Event()) is not None
        picture = source.retrieve()
        assert picture is not None
        assert (picture == 10).all()


def test_pictures_are_shown_at_the_asked_rate(tmp_path: Path) -> None:
    write_grey(tmp_path, *(f"{i}.png" for i in range(4)))
    source = FileSource(str(tmp_path), rate_hz=20.0)
    source.open()
    stop = threading.Event()
    times = [source.grab(stop) for _ in range(11)]
    assert None not in times
    assert (times[-1] - times[0]) / 1e9 == pytest.approx(10 / 20, abs=PACE_TOLERANCE_S)


def test_a_stalled_reader_is_not_served_a_burst(tmp_path: Path) -> None:
    write_grey(tmp_path, *(f"{i}.png" for i in range(4)))
    source = FileSource(str(tmp_path), rate_hz=20.0)
    source.open()
    stop = threading.Event()
    source.grab(stop)
    time.sleep(0.3)
    late, following = source.grab(stop), source.grab(stop)
    assert late is not None
    assert following is not None
    assert following - late > 0.8 / 20 * 1e9


def test_a_file_that_is_not_there_or_no_picture_says_so(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match=r"there is no file or folder .*nothing"):
        FileSource(str(tmp_path / "nothing"), 30.0).open()
    with pytest.raises(NodeError, match="no image in the folder"):
        FileSource(str(tmp_path), 30.0).open()
    (tmp_path / "a.mp4").write_bytes(b"not a video" * 100)
    with pytest.raises(NodeError, match=r"a\.mp4 is neither an image nor a video"):
        FileSource(str(tmp_path / "a.mp4"), 30.0).open()


def grab_for(source: FileSource, duration_s: float) -> None:
    give_up = time.monotonic() + duration_s
    while time.monotonic() < give_up:
        source.grab(threading.Event())


def test_a_replaced_file_is_noticed(tmp_path: Path) -> None:
    write_grey(tmp_path, "a.png", "b.png")
    source = FileSource(str(tmp_path / "a.png"), 50.0)
    source.open()
    source.grab(threading.Event())
    (tmp_path / "b.png").replace(tmp_path / "a.png")
    with pytest.raises(NodeError, match="was replaced"):
        grab_for(source, 3.0)


def test_waiting_for_the_next_picture_ends_when_told(tmp_path: Path) -> None:
    write_grey(tmp_path, "a.png")
    source = FileSource(str(tmp_path), rate_hz=0.01)
    source.open()
    stop = threading.Event()
    assert source.grab(stop) is not None
    threading.Timer(0.1, stop.set).start()
    began = time.monotonic()
    assert source.grab(stop) is None
    assert time.monotonic() - began < REFUSAL_S


# -- devices and streams --------------------------------------------------------------------------
def test_a_missing_device_says_what_to_do() -> None:
    with pytest.raises(NodeError, match=r"no /dev/video97; cameras here: .*--device=/dev/video97"):
        V4l2Source("97", CameraProfile(source="v4l2:97")).open()


def test_a_file_that_is_no_camera_says_what_may_be_wrong(tmp_path: Path) -> None:
    path = tmp_path / "video0"
    path.touch()
    with pytest.raises(NodeError, match=f"fuser -v {path}"):
        V4l2Source(str(path), CameraProfile(source=f"v4l2:{path}")).open()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open every device")
def test_a_forbidden_device_names_the_group(tmp_path: Path) -> None:
    path = tmp_path / "video0"
    path.touch(mode=0)
    assert "--groups video" in why_not(path)


def test_grabbing_from_a_device_that_is_gone_is_a_loss() -> None:
    with pytest.raises(NodeError, match="gave no image"):
        V4l2Source("0", CameraProfile(source="v4l2:0")).grab(threading.Event())


def test_the_kernels_stamp_is_used_where_it_is_sane() -> None:
    now_ns = 1000 * SECOND_NS
    assert captured_ns(999_980.0, now_ns) == now_ns - 20_000_000
    for odd_ms in (0.0, -1.0, 1_000_100.0, 1.79e12, 998_000.0):
        assert captured_ns(odd_ms, now_ns) == now_ns


def test_a_stream_where_nobody_listens_is_given_up_at_once_without_telling_the_password() -> None:
    began = time.monotonic()
    with pytest.raises(NodeError, match=r"rtsp://127\.0\.0\.1:1/cam does not answer") as refusal:
        RtspSource("rtsp://me:hush@127.0.0.1:1/cam").open()
    assert time.monotonic() - began < REFUSAL_S
    assert "hush" not in str(refusal.value)


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("rtsp://10.0.0.2/a", "rtsp://10.0.0.2/a"),
        ("rtsp://u:p@10.0.0.2:554/a@b", "rtsp://10.0.0.2:554/a@b"),
        ("rtsps://u:p@ss@host/a", "rtsps://host/a"),
        ("rtsp://host/user=u&password=p&ch=1", "rtsp://host/user=u&password=***&ch=1"),
        ("rtsp://host/a?pwd=p", "rtsp://host/a?pwd=***"),
        ("file:/a@b", "file:/a@b"),
    ],
)
def test_passwords_are_cut_out_of_addresses(url: str, shown: str) -> None:
    assert without_password(url) == shown


# -- choice ---------------------------------------------------------------------------------------
def test_all_cameras_but_those_of_ros2_are_served_unless_some_are_named() -> None:
    profile = load_profile("panda_sim").model_copy(
        update={
            "cameras": {
                "a": CameraProfile(source="sim:front"),
                "b": CameraProfile(source="v4l2:0"),
                "c": CameraProfile(source="ros2:/image"),
            }
        }
    )
    assert list(choose_cameras(profile, None)) == ["a", "b"]
    assert list(choose_cameras(profile, ("b",))) == ["b"]
    with pytest.raises(NodeError, match=r"no camera 'd'; this node can serve: a, b"):
        choose_cameras(profile, ("d",))
    with pytest.raises(NodeError, match="'c' comes from ROS 2"):
        choose_cameras(profile, ("c",))
    with pytest.raises(NodeError, match="no camera for this node"):
        choose_cameras(profile, ())


def test_an_unknown_kind_of_source_lists_the_known_ones() -> None:
    known = ", ".join(CAMERA_SOURCES)
    with pytest.raises(PluginError, match=f"no camera source 'acme' .* Installed: {known}\\."):
        make_source(CameraProfile(source="acme:1"))
    with pytest.raises(NodeError, match="'ros2:/image': no camera node reads ros2:"):
        make_source(CameraProfile(source="ros2:/image"))


@pytest.mark.parametrize("kind", CAMERA_SOURCES)
def test_every_kind_of_source_is_served_described_and_found_on_disk(
    kind: str, tmp_path: Path
) -> None:
    written, is_path = CAMERA_SOURCES[kind].written, CAMERA_SOURCES[kind].is_path
    assert written.startswith(f"{kind}:")
    assert f"``{kind}:" in (CameraProfile.__doc__ or "")
    if kind not in ELSEWHERE:
        make_source(CameraProfile(source=written))
    if is_path:
        profile = tmp_path / "lab.yaml"
        profile.write_text(f"extends: panda_sim\ncameras: {{front: {{source: '{kind}:absent'}}}}\n")
        absent = tmp_path / "absent"
        assert load_profile(str(profile)).cameras["front"].source == f"{kind}:{absent}"
        assert f"there is no file or folder {absent}" in "".join(check_profile(str(profile)).errors)


def test_what_opencv_says_of_broken_sources_does_not_reach_the_terminal(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"not a video" * 100)
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1][:40])
    program = f"""
import threading
from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.node import make_source
from vla_zenoh.nodes.camera.source import prepare_opencv
from vla_zenoh.profile.schema import CameraProfile
prepare_opencv()
for source in ("file:{tmp_path}/a.mp4", "file:{tmp_path}/a.png", "v4l2:{tmp_path}/a.mp4",
               "rtsp://127.0.0.1:1/a"):
    source = make_source(CameraProfile(source=source))
    try:
        source.open()
        source.grab(threading.Event())
        assert source.retrieve() is None
    except NodeError:
        pass
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# -- which are connected --------------------------------------------------------------------------
def lists(*names: str, maker: str = "") -> CameraPlugin:
    cameras = [FoundCamera(f"{maker or 'v4l2'}:{name}", name, "usb") for name in names]
    return CameraPlugin(written="", connected=lambda: cameras, maker=maker)


def has_no_library() -> list[FoundCamera]:
    raise MissingExtraError("acme_sdk", "sdk", package="acme-cameras")


def test_a_camera_of_a_maker_is_listed_once_by_its_own_library_where_that_is_installed() -> None:
    both = [lists("Acme One", maker="Acme"), lists("Acme One", "Webcam")]
    listed = ["Acme:Acme One", "v4l2:Webcam"]
    assert [one.source for one in connected_cameras(both)] == listed
    assert [one.source for one in connected_cameras(reversed(both))] == listed[::-1]
    without = [CameraPlugin(written="", connected=has_no_library, maker="Acme"), both[1]]
    assert [one.source for one in connected_cameras(without)] == ["v4l2:Acme One", "v4l2:Webcam"]
