"""Pictures come back as they were, and no payload makes the decoder do more than refuse."""

from __future__ import annotations

import struct
import subprocess
import sys
import textwrap
import time
import zlib

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from random_records import images, refusal

from vla_zenoh.codec import image
from vla_zenoh.codec.image import MAX_SCANS, PNG_BEGINS, decode_jpeg, decode_png, decode_png16
from vla_zenoh.errors import CodecError
from vla_zenoh.types import Image

JPEG_ERROR = 3.0  # mean absolute difference of 8-bit values at quality 90 in a smooth picture
MEMORY_LIMIT_BYTES = 2 * 1024**3  # of address space, most of it the libraries' own


def smooth(height: int = 48, width: int = 64) -> Image:
    rows, columns = np.mgrid[0:height, 0:width]
    channels = (rows * 255 // height, columns * 255 // width, np.full_like(rows, 40))
    return Image(np.stack(channels, axis=-1).astype(np.uint8))


SMOOTH = smooth()
JPEG = image.encode_jpeg(SMOOTH)
HUGE = (16_000, 10_000)  # pixels: half a gigabyte, which OpenCV would take


@given(images)
def test_a_raw_picture_comes_back_as_it_was(picture: Image) -> None:
    back = image.decode_raw(image.encode_raw(picture), image.raw_schema(picture))
    np.testing.assert_array_equal(back.rgb, picture.rgb)
    assert not back.rgb.flags.writeable


def test_a_raw_picture_that_is_not_contiguous_is_written_row_by_row() -> None:
    picture = Image(SMOOTH.rgb[::2, ::-2])
    back = image.decode_raw(image.encode_raw(picture), image.raw_schema(picture))
    np.testing.assert_array_equal(back.rgb, SMOOTH.rgb[::2, ::-2])


@pytest.mark.parametrize(
    ("payload", "schema", "reason"),
    [
        (b"", "", "malformed"),
        (bytes(12), "rgb8;2x2x3", "malformed"),
        (bytes(12), "bgr8;2x2", "malformed"),
        (bytes(12), "rgb8;2x٢", "malformed"),
        (bytes(12), "rgb8;2x2\n", "malformed"),
        (bytes(12), "rgb8;-2x-2", "malformed"),
        (b"", "rgb8;0x4", "invalid"),
        (bytes(12), "rgb8;99999x99999", "invalid"),
        (bytes(12), "rgb8;8192x8192", "invalid"),
        (bytes(11), "rgb8;2x2", "truncated"),
        (bytes(13), "rgb8;2x2", "truncated"),
        (bytes(12), "rgb8;4x2", "truncated"),
    ],
)
def test_a_wrong_raw_picture_is_refused(payload: bytes, schema: str, reason: str) -> None:
    with pytest.raises(CodecError) as caught:
        image.decode_raw(payload, schema)
    assert caught.value.reason == reason


@given(st.binary(max_size=64), st.text(max_size=20) | st.from_regex(r"rgb8;\d{1,5}x\d{1,5}"))
def test_arbitrary_raw_payloads_are_refused_or_read(payload: bytes, schema: str) -> None:
    error = refusal(image.decode_raw, payload, schema)
    assert error is None or error.reason in {"malformed", "invalid", "truncated"}


def test_a_jpeg_is_near_the_picture_and_its_colours_are_in_order() -> None:
    back = image.decode_jpeg(JPEG)
    assert back.rgb.shape == SMOOTH.rgb.shape
    assert np.abs(back.rgb.astype(int) - SMOOTH.rgb).mean() < JPEG_ERROR
    assert not back.rgb.flags.writeable
    # Another decoder agrees on which channel is red.
    bgr = cv2.imdecode(np.frombuffer(JPEG, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(back.rgb, bgr[..., ::-1])


@given(images)
@settings(max_examples=40)
def test_a_jpeg_of_any_size_has_that_size(picture: Image) -> None:
    assert image.decode_jpeg(image.encode_jpeg(picture)).rgb.shape == picture.rgb.shape


@pytest.mark.parametrize("flags", [cv2.IMWRITE_JPEG_PROGRESSIVE, cv2.IMWRITE_JPEG_OPTIMIZE])
def test_other_forms_of_jpeg_are_read(flags: int) -> None:
    ok, data = cv2.imencode(".jpg", SMOOTH.rgb, [flags, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2])
    assert ok
    assert image.decode_jpeg(data.tobytes()).rgb.shape == SMOOTH.rgb.shape


def test_padding_behind_the_end_of_a_jpeg_is_read() -> None:
    assert image.decode_jpeg(JPEG + bytes(7)).rgb.shape == SMOOTH.rgb.shape


def test_a_long_comment_before_the_picture_is_passed_over() -> None:
    comment = b"\xff\xfe" + (1002).to_bytes(2, "big") + bytes(1000)
    assert image.decode_jpeg(JPEG[:2] + comment + JPEG[2:]).rgb.shape == SMOOTH.rgb.shape


def frame_header(height: int, width: int) -> bytes:
    numbers = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return b"\xff\xc0\x00\x11\x08" + numbers + b"\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01"


def resized(height: int, width: int) -> bytes:
    at = JPEG.index(b"\xff\xc0")
    header = frame_header(height, width)
    return JPEG[:at] + header + JPEG[at + len(header) :]


def hidden_behind(marker: int) -> bytes:
    """Huge for who passes over `marker` alone, small for who takes a length to be behind it."""
    huge = resized(*HUGE)[2:]
    length = (2 + len(huge)).to_bytes(2, "big")
    return b"\xff\xd8\xff" + bytes([marker]) + length + huge + frame_header(8, 8) + b"\xff\xd9"


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "malformed"),
        (b"\x89PNG\r\n\x1a\n", "malformed"),
        (b"\xff\xd8\xff", "truncated"),
        (JPEG[:-2], "truncated"),
        (JPEG[: len(JPEG) // 2], "truncated"),
        (b"\xff\xd8\xff\xd9", "malformed"),
        (b"\xff\xd8\xff\xe0\x00\x00\xff\xd9", "malformed"),
        (b"\xff\xd8\xff\xe0\x00\x01\xff\xd9", "malformed"),
        (b"\xff\xd8\xff\xff\xff\xff\xff\xd9", "malformed"),
        (b"\xff\xd8" + frame_header(8, 8) + b"\xff\xd9", "malformed"),
        (resized(0, 64), "invalid"),
        (resized(65535, 65535), "invalid"),
        (resized(8192, 8192), "invalid"),
        (resized(64, 8193), "invalid"),
        (hidden_behind(0x01), "malformed"),
        (hidden_behind(0xD0), "malformed"),
        (hidden_behind(0xD7), "malformed"),
        (bytes([0xFF, 0xD8, 0xFF]) + bytes(image.MAX_JPEG_BYTES), "oversize"),
    ],
)
def test_a_wrong_jpeg_is_refused(payload: bytes, reason: str) -> None:
    with pytest.raises(CodecError) as caught:
        image.decode_jpeg(payload)
    assert caught.value.reason == reason


@given(st.binary(max_size=200), st.booleans())
def test_arbitrary_jpegs_are_refused(payload: bytes, dressed: bool) -> None:
    error = refusal(
        image.decode_jpeg, b"\xff\xd8\xff" + payload + b"\xff\xd9" if dressed else payload
    )
    assert error is not None
    assert error.reason in {"malformed", "invalid", "truncated"}


@given(st.data())
@settings(max_examples=200)
def test_flipped_bits_in_a_jpeg_are_refused_or_read(data: st.DataObject) -> None:
    payload = bytearray(JPEG)
    for _ in range(data.draw(st.integers(1, 3))):
        # Most of them in the headers, where sizes and tables are.
        last = len(payload) - 1
        at = data.draw(st.integers(0, JPEG.index(b"\xff\xda")) | st.integers(0, last))
        payload[at] ^= 1 << data.draw(st.integers(0, 7))
    error = refusal(image.decode_jpeg, bytes(payload))
    assert error is None or error.reason in {"malformed", "invalid", "truncated"}


def test_forged_sizes_take_no_memory() -> None:
    script = f"""
        import resource, sys
        from vla_zenoh.codec import image
        from vla_zenoh.errors import CodecError
        resource.setrlimit(resource.RLIMIT_AS, ({MEMORY_LIMIT_BYTES}, {MEMORY_LIMIT_BYTES}))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for payload in sys.argv[1:]:
            try:
                image.decode_jpeg(bytes.fromhex(payload))
            except CodecError as error:
                print(error.reason)
        print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
    """
    payloads = [resized(*HUGE), hidden_behind(0x01), hidden_behind(0xD3)]
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), *(p.hex() for p in payloads)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    *reasons, grown_mib = done.stdout.split()
    assert reasons == ["invalid", "malformed", "malformed"], done.stderr
    assert int(grown_mib) < 50


def test_a_host_without_opencv_reads_and_writes_jpegs_and_names_the_extra_for_other_files() -> None:
    script = """
        import sys
        sys.modules["cv2"] = None
        import numpy as np
        from vla_zenoh.codec import image
        from vla_zenoh.errors import MissingExtraError
        from vla_zenoh.types import Depth
        given = np.frombuffer(bytes.fromhex(sys.argv[1]), np.uint8).reshape(48, 64, 3)
        print(image.encode_jpeg(image.Image(given)).hex())
        print(image.decode_jpeg(bytes.fromhex(sys.argv[2])).rgb.tobytes().hex())
        try:
            image.encode_depth(Depth(np.ones((8, 8), np.uint16), 0.001))
        except MissingExtraError as error:
            print(error)
    """
    given = [SMOOTH.rgb.tobytes().hex(), JPEG.hex()]
    command = [sys.executable, "-c", textwrap.dedent(script), *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    written, read, error = done.stdout.splitlines()
    far = image.decode_jpeg(bytes.fromhex(written)).rgb.astype(int) - SMOOTH.rgb
    assert np.abs(far).mean() < JPEG_ERROR
    assert bytes.fromhex(read) == image.decode_jpeg(JPEG).rgb.tobytes()
    assert "camera" in error


@pytest.mark.parametrize(("colours", "channels"), [("GRAY", 1), ("CMYK", 4)])
def test_foreign_colours_are_read_as_opencv_reads_them(colours: str, channels: int) -> None:
    pixels = np.random.default_rng(5).integers(0, 256, (16, 24, channels), dtype=np.uint8)
    data = simplejpeg.encode_jpeg(pixels, 90, colours, "Gray" if channels == 1 else "444")
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(image.decode_jpeg(data).rgb, bgr[..., ::-1])


def test_a_picture_that_nobody_would_read_is_not_written() -> None:
    long = Image(np.broadcast_to(np.zeros(3, np.uint8), (1, image.MAX_SIDE + 1, 3)))
    with pytest.raises(CodecError, match=f"sides are 1 to {image.MAX_SIDE}"):
        image.encode_jpeg(long)


def test_a_progressive_jpeg_of_endless_scans_is_refused_before_it_is_decoded() -> None:
    pixels = np.zeros((16, 16, 3), np.uint8)
    _, made = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    data = made.tobytes()
    assert decode_jpeg(data).rgb.shape == (16, 16, 3)
    last_scan = data[data.rfind(b"\xff\xda") : -2]
    with pytest.raises(CodecError, match="scans, at most"):
        decode_jpeg(data[:-2] + MAX_SCANS * last_scan + data[-2:])


def png_of(*chunks: tuple[bytes, bytes]) -> bytes:
    made = [PNG_BEGINS]
    for name, data in chunks:
        crc = zlib.crc32(name + data)
        made.append(struct.pack(">I", len(data)) + name + data + struct.pack(">I", crc))
    return b"".join(made)


UNPACKED_BYTES, PATIENCE_S = 7 * 2**20, 2.0
BOMB = zlib.compress(bytes(UNPACKED_BYTES), 9)


@pytest.mark.parametrize("chunk", [(b"zTXt", b"a\0\0" + BOMB), (b"iTXt", b"a\0\1\0\0\0" + BOMB)])
def test_texts_in_a_png_that_unpack_to_gigabytes_are_not_unpacked(
    chunk: tuple[bytes, bytes],
) -> None:
    head = (b"IHDR", struct.pack(">IIBBBBB", 4, 2, 16, 0, 0, 0, 0))
    pixels = (b"IDAT", zlib.compress(bytes(2 * 9)))
    data = png_of(head, *[chunk] * 500, pixels, (b"IEND", b""))
    began_s = time.process_time()
    assert decode_png16(data).shape == (2, 4)
    assert decode_png(data).rgb.shape == (2, 4, 3)
    assert time.process_time() - began_s < PATIENCE_S


def test_an_animated_png_is_its_still_image() -> None:
    head = (b"IHDR", struct.pack(">IIBBBBB", 4, 2, 16, 0, 0, 0, 0))
    animation = (b"acTL", struct.pack(">II", 2, 0))
    frame = (b"fcTL", struct.pack(">IIIIIHHBB", 0, 4, 2, 0, 0, 1, 1, 0, 0))
    with pytest.raises(CodecError, match="decoded"):
        decode_png16(png_of(head, animation, frame, (b"IDAT", b""), (b"IEND", b"")))


NO_PNGS = {"a jpeg": JPEG, "cut off": PNG_BEGINS + bytes(15), "another": b"PNG" + bytes(99)}


@pytest.mark.parametrize("payload", NO_PNGS.values(), ids=NO_PNGS)
def test_what_does_not_begin_as_a_png_is_none(payload: bytes) -> None:
    with pytest.raises(CodecError, match=r"not a PNG file$"):
        decode_png(payload)
