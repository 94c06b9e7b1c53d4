"""Depth pictures on the wire: the same counts and the same unit come out, or an error."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vla_zenoh.codec.image import MAX_SIDE, PNG_ENDS, decode_depth, depth_schema, encode_depth
from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.types import Depth

SEED = 3


def noisy(unit_m: float = 0.001) -> Depth:
    counts = np.random.default_rng(SEED).integers(0, 2**16, (48, 64), dtype=np.uint16)
    return Depth(counts, unit_m)


@pytest.mark.parametrize("unit_m", [0.001, 0.0001, 0.00025, 1e-5, 0.1, 1 / 3 * 1e-2])
def test_every_count_and_the_unit_come_out_as_they_went_in(unit_m: float) -> None:
    depth = noisy(unit_m)
    back = decode_depth(encode_depth(depth), depth_schema(depth))
    np.testing.assert_array_equal(back.counts, depth.counts)
    assert back.unit_m == pytest.approx(unit_m, rel=1e-8)


def test_a_distance_that_no_count_can_say_is_not_measured() -> None:
    metres = np.array([[np.nan, np.inf, -1.0, 0.0], [0.0004, 0.0006, 65.535, 65.54]])
    depth = Depth.of_metres(metres, 0.001)
    np.testing.assert_array_equal(depth.counts, [[0, 0, 0, 0], [0, 1, 65535, 0]])
    np.testing.assert_allclose((depth.counts * depth.unit_m)[1], [0, 0.001, 65.535, 0], rtol=1e-6)


@pytest.mark.parametrize("schema", ["", "depth16", "rgb8;48x64", "depth16;", "depth16;nan"])
def test_without_a_unit_a_picture_is_no_depth(schema: str) -> None:
    with pytest.raises(CodecError, match="METRES_A_COUNT"):
        decode_depth(encode_depth(noisy()), schema)


@pytest.mark.parametrize("unit", ["0.0", "7", "999", "1e-9"])
def test_a_unit_out_of_range_is_an_error(unit: str) -> None:
    with pytest.raises(CodecError, match="unit_m"):
        decode_depth(encode_depth(noisy()), f"depth16;{unit}")


def test_eight_bits_and_colours_are_no_depth() -> None:
    for picture in (np.ones((8, 8), np.uint8), np.ones((8, 8, 3), np.uint16)):
        _, data = cv2.imencode(".png", picture)
        with pytest.raises(CodecError, match="one channel of 16 bits"):
            decode_depth(data.tobytes(), "depth16;0.001")


def test_a_cut_or_foreign_file_is_an_error() -> None:
    data = encode_depth(noisy())
    for broken, what in ((data[:-20], "without its end"), (b"\xff\xd8\xff", "not a PNG")):
        with pytest.raises(CodecError, match=what):
            decode_depth(broken, "depth16;0.001")
    with pytest.raises(CodecError, match="decoded"):
        decode_depth(data[:60] + PNG_ENDS, "depth16;0.001")


def test_a_header_that_asks_for_too_many_pixels_is_refused_before_they_are_made() -> None:
    data = bytearray(encode_depth(noisy()))
    data[16:20] = (MAX_SIDE + 1).to_bytes(4, "big")
    with pytest.raises(CodecError, match="sides are"):
        decode_depth(bytes(data), "depth16;0.001")


def test_a_record_of_depth_has_sixteen_bits_and_two_axes() -> None:
    for counts in (np.ones((4, 4), np.uint8), np.ones((4, 4, 1), np.uint16)):
        with pytest.raises(RecordError, match="uint16"):
            Depth(counts, 0.001)
    with pytest.raises(RecordError, match="wanted"):
        Depth(np.ones((0, 4), np.uint16), 0.001)
    with pytest.raises(RecordError, match="unit_m"):
        Depth(np.ones((4, 4), np.uint16), 0.0)
