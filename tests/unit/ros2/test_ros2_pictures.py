"""Every encoding of sensor_msgs/image_encodings: read as what it shows, or rejected by its name."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.pictures import COLOURS, COMPRESSED_IMAGE, DEPTHS, IMAGE
from vla_zenoh_ros2.readers import read, read_depth

from vla_zenoh.errors import CodecError

JAZZY = Messages("jazzy")
HEIGHT, WIDTH = 12, 16
RGB = (200, 120, 40)
TOLERANCE = 4
"""Of 255, after a conversion from YUV."""
ABSTRACT = [
    f"{bits}{kind}{channels}"
    for bits, kind in (
        (8, "UC"),
        (8, "SC"),
        (16, "UC"),
        (16, "SC"),
        (32, "SC"),
        (32, "FC"),
        (64, "FC"),
    )
    for channels in (1, 2, 3, 4)
]
NAMED = [
    *(f"{order}{bits}" for order in ("rgb", "rgba", "bgr", "bgra", "mono") for bits in (8, 16)),
    *(f"bayer_{order}{bits}" for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)),
    *("yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv21", "nv24"),
]
"""With `ABSTRACT` all of sensor_msgs/image_encodings.hpp."""


def image(
    encoding: str, pixels: Any, height: int, width: int, *, big: bool = False, pad: int = 0
) -> bytes:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    message = JAZZY.new(
        IMAGE,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.ravel(),
    )
    return JAZZY.encode(message)


def compressed(form: str, payload: bytes) -> bytes:
    data = np.frombuffer(payload, np.uint8)
    return JAZZY.encode(JAZZY.new(COMPRESSED_IMAGE, format=form, data=data))


def one_colour(encoding: str, big: bool) -> np.ndarray[Any, Any]:
    """Pixels of `RGB` in an encoding; of a mono one, of its first value."""
    name = encoding.removesuffix("16") if encoding in DEEP else encoding.removesuffix("8")
    red, green, blue = RGB
    if name.startswith("bayer_"):
        value = {"r": red, "g": green, "b": blue}
        tile = np.array([value[c] for c in name.removeprefix("bayer_")]).reshape(2, 2)
        pixels = np.tile(tile, (HEIGHT // 2, WIDTH // 2))
    elif name in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        # ITU-R BT.601, as image_pipeline and OpenCV.
        y = 16 + (65.738 * red + 129.057 * green + 25.064 * blue) / 256
        u = 128 + (-37.945 * red - 74.494 * green + 112.439 * blue) / 256
        v = 128 + (112.439 * red - 94.154 * green - 18.285 * blue) / 256
        pair = (u, y, v, y) if name in ("yuv422", "uyvy") else (y, u, y, v)
        pixels = np.tile(np.rint(pair), (HEIGHT, WIDTH // 2))
    elif name in ("mono", "8UC1"):
        pixels = np.full((HEIGHT, WIDTH), red)
    else:
        values = {"r": red, "g": green, "b": blue, "a": 7}
        pixels = np.tile([values[letter] for letter in name], (HEIGHT, WIDTH))
    if encoding in DEEP:
        return (pixels * 257).astype(">u2" if big else "<u2")
    return pixels.astype(np.uint8)


DEEP = {name for name, one in COLOURS.items() if one.type == "u2"}


@pytest.mark.parametrize("pad", [0, 6])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", [*NAMED, *ABSTRACT])
def test_every_encoding_is_read_as_what_it_shows_or_rejected_by_its_name(
    encoding: str, big: bool, pad: int
) -> None:
    if encoding not in COLOURS:
        with pytest.raises(CodecError, match=f"'{encoding}'") as caught:
            read(JAZZY, IMAGE, image(encoding, np.zeros((4, 64), np.uint8), 4, 2))
        assert caught.value.reason == "encoding"
        assert ("distances" in str(caught.value)) == (encoding in DEPTHS)
        return
    pixels = one_colour(encoding, big)
    found = read(JAZZY, IMAGE, image(encoding, pixels, HEIGHT, WIDTH, big=big, pad=pad)).rgb
    wanted = RGB if encoding not in ("mono8", "8UC1") else (RGB[0],) * 3
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert found.dtype == np.uint8
    inside = found[2:-2, 2:-2].astype(int)
    assert np.abs(inside - wanted).max() <= TOLERANCE


def test_encodings_that_simulators_and_cameras_publish_are_read() -> None:
    wanted = {"rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422", "uyvy", "yuv422_yuy2", "yuyv"}
    wanted |= {f"bayer_{order}8" for order in ("rggb", "bggr", "gbrg", "grbg")}
    assert wanted <= set(COLOURS)


@given(
    st.sampled_from([*COLOURS, *DEPTHS]),
    st.integers(0, 9),
    st.integers(0, 9),
    st.integers(0, 80),
    st.binary(max_size=300),
)
def test_any_size_of_any_encoding_is_read_or_rejected(
    encoding: str, height: int, width: int, step: int, data: bytes
) -> None:
    message = JAZZY.new(
        IMAGE,
        height=height,
        width=width,
        encoding=encoding,
        step=step,
        data=np.frombuffer(data, np.uint8),
    )
    payload = JAZZY.encode(message)
    for reads in (read, read_depth):
        try:
            found = reads(JAZZY, IMAGE, payload)
        except CodecError:
            continue
        assert (found.rgb if reads is read else found.depth_m).shape[:2] == (height, width)


# -- depth ----------------------------------------------------------------------------------------
COUNTS = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 20


def png(pixels: Any) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


@pytest.mark.parametrize("big", [False, True])
def test_depth_is_read_in_metres(big: bool) -> None:
    order = ">" if big else "<"
    for encoding, values in (
        ("16UC1", COUNTS.astype(f"{order}u2")),
        ("mono16", COUNTS.astype(f"{order}u2")),
        ("32FC1", (COUNTS / 1000).astype(f"{order}f4")),
    ):
        found = read_depth(JAZZY, IMAGE, image(encoding, values, HEIGHT, WIDTH, big=big))
        assert found.depth_m == pytest.approx(COUNTS / 1000, abs=1e-6)
    with pytest.raises(CodecError, match="depth of encoding 'bgr8'"):
        read_depth(JAZZY, IMAGE, image("bgr8", np.zeros((4, 12), np.uint8), 4, 4))


QUANTISED = (100.0, 1.0)
HEADER = struct.pack("<iff", 0, *QUANTISED)


@pytest.mark.parametrize(
    ("form", "payload"),
    [
        ("png", png(COUNTS)),
        ("16UC1; png compressed", png(COUNTS)),
        ("16UC1; compressedDepth", HEADER + png(COUNTS)),
        ("16UC1; compressedDepth png", HEADER + png(COUNTS)),
        ("16UC1; compressedDepth png", png(COUNTS)),
    ],
)
def test_compressed_depth_is_read_in_metres_and_never_shown_as_a_picture(
    form: str, payload: bytes
) -> None:
    found = read_depth(JAZZY, COMPRESSED_IMAGE, compressed(form, payload))
    assert found.depth_m == pytest.approx(COUNTS / 1000, abs=1e-6)
    with pytest.raises(CodecError, match="it holds distances") as caught:
        read(JAZZY, COMPRESSED_IMAGE, compressed(form, payload))
    assert caught.value.reason == "encoding"


def test_metres_that_image_transport_quantised_are_read() -> None:
    metres = np.linspace(0.3, 9.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    a, b = QUANTISED[0] * 100, 5.0
    counts = np.rint(a / metres + b).astype(np.uint16)
    counts[0, 0] = 0
    payload = struct.pack("<iff", 0, a, b) + png(counts)
    found = read_depth(JAZZY, COMPRESSED_IMAGE, compressed("32FC1; compressedDepth png", payload))
    assert found.depth_m[0, 0] == 0
    assert found.depth_m.ravel()[1:] == pytest.approx(metres.ravel()[1:], rel=5e-3)


@pytest.mark.parametrize(
    ("form", "payload"),
    [
        ("16UC1; compressedDepth rvl", HEADER + bytes(40)),
        ("16UC1; compressedDepth png", HEADER[:7]),
        ("16UC1; compressedDepth png", HEADER + png(COUNTS)[:-9]),
        ("png", png(np.zeros((4, 4, 3), np.uint8))),
        ("jpeg", b"\xff\xd8\xff\xd9"),
    ],
)
def test_what_is_no_depth_is_rejected_with_what_it_is(form: str, payload: bytes) -> None:
    with pytest.raises(CodecError):
        read_depth(JAZZY, COMPRESSED_IMAGE, compressed(form, payload))
