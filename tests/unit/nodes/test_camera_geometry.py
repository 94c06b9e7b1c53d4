"""Undistortion, crop and flip: where a point of the world ends up, and what the intrinsics say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_realsense.source import WINDOW_S, DeviceClock

from vla_zenoh.errors import NodeError, ProfileError
from vla_zenoh.nodes.camera.geometry import Geometry, Intrinsics, read_intrinsics
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.schema import CameraProfile, Crop

WIDTH, HEIGHT = 320, 240
LENS = Intrinsics(
    width=WIDTH,
    height=HEIGHT,
    fx_px=260.0,
    fy_px=255.0,
    cx_px=170.0,
    cy_px=115.0,
    distortion=(-0.25, 0.08, 0.002, -0.001, 0.0),
)
TOLERANCE_PX = 0.7


def camera(**fields: Any) -> CameraProfile:
    return CameraProfile(**{"source": "realsense:1", "width": WIDTH, "height": HEIGHT, **fields})


def project(lens: Intrinsics, point: np.ndarray) -> np.ndarray:
    """Pixel (corner of the first one is 0, 0) of a point in front of the camera."""
    coefficients = np.array([*lens.distortion, *[0.0] * (5 - len(lens.distortion))])
    pixel, _ = cv2.projectPoints(
        point.reshape(1, 1, 3), np.zeros(3), np.zeros(3), lens.matrix, coefficients
    )
    return np.asarray(pixel).ravel() + 0.5


def dot(at: np.ndarray) -> np.ndarray:
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    far = (columns - at[0]) ** 2 + (rows - at[1]) ** 2
    return np.repeat((255 * np.exp(-far / 18))[..., None], 3, axis=2).astype(np.uint8)


def centre(image: np.ndarray) -> np.ndarray:
    weight = image[..., 0].astype(float)
    rows, columns = np.indices(weight.shape) + 0.5
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


MIRROR = {
    "none": (1, 1),
    "horizontal": (-1, 1),
    "vertical": (1, -1),
    "both": (-1, -1),
}


@pytest.mark.parametrize("undistort", [False, True])
@pytest.mark.parametrize("flip", MIRROR)
@pytest.mark.parametrize(
    "fields", [{}, {"crop": Crop(left=40, top=30, width=240, height=180), "width": 480}], ids=str
)
def test_a_point_is_where_the_intrinsics_of_what_comes_out_say(
    undistort: bool, flip: str, fields: dict[str, Any]
) -> None:
    point = np.array([-0.2, 0.18, 1.0])
    geometry = Geometry(camera(undistort=undistort, flip=flip, **fields), LENS)
    out = geometry.apply(dot(project(LENS, point)))
    assert out.shape[:2] == (HEIGHT, fields.get("width", WIDTH))
    seen = geometry.intrinsics()
    assert seen is not None
    assert bool(seen.distortion) == (not undistort)
    x, y = MIRROR[flip]
    assert np.abs(centre(out) - project(seen, point * (x, y, 1))).max() < TOLERANCE_PX


def test_without_anything_to_do_an_image_goes_through_as_it_is() -> None:
    image = dot(np.array([100.0, 80.0]))
    geometry = Geometry(camera())
    assert geometry.apply(image) is image
    assert geometry.intrinsics() is None


def test_depth_is_never_a_mean_of_two_distances() -> None:
    depth_m = np.where(np.arange(WIDTH) % 2 == 0, 0.5, 2.0) * np.ones((HEIGHT, 1))
    shape = camera(undistort=True, width=200, height=100, flip="both")
    out = Geometry(shape, LENS).apply(depth_m.astype(np.float32), depth=True)
    assert out.shape == (100, 200)
    assert set(np.unique(out)) <= {0.0, 0.5, 2.0}, "beyond the lens nothing was measured"


def test_a_lens_calibrated_at_another_size_is_scaled() -> None:
    twice = LENS.scaled(2 * WIDTH, 2 * HEIGHT)
    one, other = Geometry(camera(undistort=True), LENS), Geometry(camera(undistort=True), twice)
    image = dot(np.array([60.0, 190.0]))
    np.testing.assert_array_equal(one.apply(image), other.apply(image))
    assert one.intrinsics() == other.intrinsics()


def test_a_crop_beyond_the_image_is_an_error() -> None:
    beyond = camera(crop=Crop(left=100, top=0, width=240, height=240))
    with pytest.raises(NodeError, match="240x240 at 100, 0 reaches beyond the camera's image"):
        Geometry(beyond).apply(dot(np.zeros(2)))


def test_intrinsics_come_from_a_file_beside_the_profile(tmp_path: Path) -> None:
    (tmp_path / "lens.yaml").write_text(
        "width: 640\nheight: 480\nfx_px: 500\nfy_px: 501\ncx_px: 320\ncy_px: 240\n"
        "distortion: [-0.1, 0.01]\n"
    )
    (tmp_path / "own.yaml").write_text(
        "extends: panda_sim\ncameras: {front: {source: 'v4l2:0', intrinsics: lens.yaml}}\n"
    )
    front = load_profile(str(tmp_path / "own.yaml")).cameras["front"]
    assert front.intrinsics == str(tmp_path / "lens.yaml")
    seen = Geometry(front).intrinsics()
    assert seen is not None
    assert seen.shown() == {
        **{"fx_px": 500, "fy_px": 501, "cx_px": 320, "cy_px": 240},
        **{"k1": -0.1, "k2": 0.01},
    }


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("width: 640", "height"),
        ("[1, 2", "is not YAML"),
        ("fx_px: .nan\nwidth: 640\nheight: 480\nfy_px: 1\ncx_px: 1\ncy_px: 1", "fx_px"),
        ("\xff\xfe", "wants a map"),
    ],
)
def test_a_wrong_file_of_intrinsics_is_named(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "lens.yaml"
    path.write_text(text, "latin-1")
    with pytest.raises(NodeError, match=why):
        read_intrinsics(path)
    with pytest.raises(NodeError, match="cannot be read"):
        read_intrinsics(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        (
            {"source": "sim:front", "flip": "both"},
            "flip: is set, and works with file:, realsense:, rtsp:, rtsps:, v4l2: only",
        ),
        ({"source": "rtsp://a/b", "exposure_us": 100.0}, "works with realsense:, v4l2: only"),
        ({"source": "v4l2:0", "depth_unit_m": 0.001}, "v4l2: measures no depth"),
        ({"source": "v4l2:0", "undistort": True}, "undistort needs the file with the lens"),
    ],
)
def test_what_a_source_cannot_do_is_an_error_of_the_profile(
    fields: dict[str, Any], why: str
) -> None:
    with pytest.raises(ProfileError, match=why):
        override(load_profile("panda_sim"), {"cameras": {"front": fields}})


# -- clock ----------------------------------------------------------------------------------------
@given(
    st.floats(-100e-6, 100e-6),
    st.lists(st.floats(0, 0.05), min_size=60, max_size=200),
    st.integers(0, 2**40),
)
def test_a_stamp_is_brought_to_this_clock_whatever_the_delay_of_each_image(
    drift: float, delays_s: list[float], began_ns: int
) -> None:
    clock, period_s = DeviceClock(), 1 / 30
    delays_s = [0.0, *delays_s]  # one image came at once
    for number, delay_s in enumerate(delays_s):
        taken_ns = 10**15 + round(number * period_s * 1e9)
        device_ns = began_ns + round(number * period_s * 1e9 * (1 + drift))
        found_ns = clock.host_ns(device_ns, taken_ns + round(delay_s * 1e9))
        assert found_ns <= taken_ns + round(delay_s * 1e9), "not later than it arrived"
        assert abs(found_ns - taken_ns) <= 2 * WINDOW_S * 100e-6 * 1e9


def test_a_camera_whose_clock_was_set_is_believed_anew() -> None:
    clock = DeviceClock()
    assert clock.host_ns(5_000_000_000, 70_000_000_000) == 70_000_000_000
    assert clock.host_ns(1_000_000, 70_033_000_000) == 70_033_000_000
    assert clock.host_ns(34_000_000, 70_076_000_000) == 70_066_000_000
