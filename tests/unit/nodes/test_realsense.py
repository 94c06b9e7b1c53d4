"""A RealSense camera, played by the SDK's own software device: no camera is needed, the SDK is.

``make test-realsense`` runs this in an environment that has it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import Rig, await_match, camera_rig, until
from depth_rig import Looker, looking
from vla_zenoh_realsense.source import RealsenseSource

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec.image import decode_depth
from vla_zenoh.errors import NodeError
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import depths
from vla_zenoh.profile.schema import CameraProfile, Crop

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

SERIAL = "843112070001"
WIDTH, HEIGHT, RATE_HZ = 64, 48, 30
UNIT_M = 0.001
LATE_S = 0.3
MEASURED_SHARE = 0.9
"""The SDK's alignment leaves a row out where both lenses are the very same."""


class SoftwareCamera:
    """Colour and depth of the SDK's software device, as a D400 gives them."""

    def __init__(self, colour: Any = None, domain: Any = None) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, SERIAL)
        self.device.register_info(rs.camera_info.name, "software")
        self._format = colour or rs.format.bgr8
        self._domain = domain or rs.timestamp_domain.hardware_clock
        self._depth = self.device.add_sensor("Stereo Module")
        self.colour = self.device.add_sensor("RGB Camera")
        self._depth.add_read_only_option(rs.option.depth_units, UNIT_M)
        self._streams = {
            self._depth: self._add(self._depth, rs.stream.depth, 1, 2, rs.format.z16),
            self.colour: self._add(self.colour, rs.stream.color, 2, 3, self._format),
        }
        same = rs.extrinsics()
        same.rotation, same.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
        depth, colours = self._streams.values()
        depth.register_extrinsics_to(colours, same)
        colours.register_extrinsics_to(depth, same)
        self.device.create_matcher(rs.matchers.dlr_c)
        self._kept: list[Any] = []
        self._stop = threading.Event()
        self.shown = 0

    @staticmethod
    def _add(sensor: Any, kind: Any, uid: int, size: int, form: Any) -> Any:
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy = WIDTH, HEIGHT, 50.0, 51.0
        lens.ppx, lens.ppy, lens.model = 31.0, 24.0, rs.distortion.brown_conrady
        lens.coeffs = [0.0] * 5
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = kind, 0, uid, form
        stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, RATE_HZ, size
        stream.intrinsics = lens
        return sensor.add_video_stream(stream)

    def show(self, number: int) -> None:
        pictures = (
            (self._depth, np.full((HEIGHT, WIDTH), 500 + number % 256, np.uint16), 2),
            (self.colour, np.zeros((HEIGHT, WIDTH, 3), np.uint8), 3),
        )
        pictures[1][1][:] = (number % 256, 20, 200)
        for sensor, pixels, size in pictures:
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, WIDTH * size, size
            frame.timestamp = number * 1000 / RATE_HZ + 5_000
            if self._domain == rs.timestamp_domain.global_time:
                frame.timestamp = time.time() * 1000
            frame.domain, frame.frame_number = self._domain, number
            frame.profile = self._streams[sensor].as_video_stream_profile()
            if sensor is self._depth:
                frame.depth_units = UNIT_M
            self._kept.append(pixels)
            sensor.on_video_frame(frame)
        self.shown = number

    def run(self) -> None:
        number = 1
        while not self._stop.wait(1 / RATE_HZ):
            self.show(number)
            number += 1

    @contextmanager
    def filming(self) -> Iterator[None]:
        thread = threading.Thread(target=self.run)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()


def profile(**fields: Any) -> CameraProfile:
    size = {"width": WIDTH, "height": HEIGHT, "rate_hz": RATE_HZ}
    return CameraProfile(**{"source": f"realsense:{SERIAL}", **size, **fields})


@contextmanager
def opened(camera: SoftwareCamera, **fields: Any) -> Iterator[RealsenseSource]:
    source = RealsenseSource(SERIAL, profile(**fields), lambda _: camera.device)
    source.open()
    try:
        with camera.filming():
            yield source
    finally:
        source.close()


def test_colour_and_depth_are_of_one_frame_and_have_the_intrinsics_of_colour() -> None:
    with opened(SoftwareCamera(), depth_unit_m=UNIT_M) as source:
        for _ in range(10):
            assert source.grab(threading.Event()) is not None
            image, depth_m = source.retrieve(), source.depth_m()
            assert image is not None
            assert depth_m is not None
            assert image.shape == (HEIGHT, WIDTH, 3)
            number, green, red = image[HEIGHT // 2, WIDTH // 2].tolist()
            assert (green, red) == (20, 200), "BGR, as OpenCV has it"
            middle_m = depth_m[HEIGHT // 2, WIDTH // 2]
            assert middle_m == pytest.approx((500 + number) * UNIT_M, abs=UNIT_M / 2)
        assert source.intrinsics is not None
        assert source.intrinsics.shown() == {
            **{"fx_px": 50.0, "fy_px": 51.0, "cx_px": 31.5, "cy_px": 24.5}
        }


def test_the_other_order_of_colours_comes_out_the_same() -> None:
    with opened(SoftwareCamera(rs.format.rgb8)) as source:
        assert source.grab(threading.Event()) is not None
        image = source.retrieve()
        assert image is not None
        assert image[0, 0, 1:].tolist() != [20, 200]
        assert image[0, 0, 0] == 200
        assert source.depth_m() is None, "nobody asked for it"


@pytest.mark.parametrize("domain", ["hardware_clock", "global_time"])
def test_stamps_come_on_the_clock_of_this_computer(domain: str) -> None:
    camera = SoftwareCamera(domain=getattr(rs.timestamp_domain, domain))
    with opened(camera) as source:
        stamps: list[int] = []
        for _ in range(20):
            mono_ns = source.grab(threading.Event())
            now_ns = time.monotonic_ns()
            assert mono_ns is not None
            assert 0 <= now_ns - mono_ns < LATE_S * 1e9
            stamps.append(mono_ns)
        assert stamps == sorted(stamps)
        assert source.stamp_ns is not None


def test_a_camera_that_falls_silent_is_lost_by_name() -> None:
    source = RealsenseSource(SERIAL, profile(), lambda _: SoftwareCamera().device)
    source.open()
    with pytest.raises(NodeError, match=rf"{SERIAL} gave no image for 2 s"):
        source.grab(threading.Event())
    source.close()
    source.close()


def test_a_camera_that_cannot_fix_its_exposure_says_so() -> None:
    locked = profile(exposure_us=8000.0)
    source = RealsenseSource(SERIAL, locked, lambda _: SoftwareCamera().device)
    with pytest.raises(NodeError, match="has no exposure to fix"):
        source.open()
    source.close()


def test_a_serial_number_that_is_not_connected_is_an_error() -> None:
    with pytest.raises(NodeError, match="no RealSense camera with the serial number '1'"):
        RealsenseSource("1", profile()).open()


def heard(rig: Rig, key: str, count: int) -> list[Any]:
    frames, subscriber = rig.listen(key)
    await_match(rig.session, key)
    until(f"{count} frames of {key}", lambda: len(frames) >= count)
    subscriber.undeclare()
    return frames


def test_through_the_node_depth_comes_flipped_and_cropped_as_its_colour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = SoftwareCamera()
    monkeypatch.setattr(RealsenseSource.__init__, "__defaults__", (lambda _: camera.device,))
    part = Crop(left=8, top=8, width=32, height=24)
    settings = profile(depth_unit_m=UNIT_M, flip="both", crop=part, width=32, height=24)
    with camera_rig({"wrist": settings}) as rig, camera.filming():
        rig.wait_for("wrist", "ok")
        frames = heard(rig, rig.profile.keys.camera_depth("wrist"), 5)
        depth = decode_depth(frames[-1].payload, frames[-1].encoding.partition(";")[2])
        assert depth.counts.shape == (24, 32)
        assert depth.unit_m == UNIT_M
        measured = depth.counts > 0
        assert measured.mean() > MEASURED_SHARE
        assert (depth.counts[measured] >= 500).all()
        colour = heard(rig, rig.profile.keys.camera_raw("wrist"), 5)[-1]
        assert colour.rgb.shape == (24, 32, 3)
        told = until("intrinsics", lambda: rig.camera("wrist").get("intrinsics"))
        assert told == {"fx_px": 50.0, "fy_px": 51.0, "cx_px": 8.5, "cy_px": 7.5}
        _again = heard(rig, rig.profile.keys.camera_depth("wrist"), 30)
        told = until("a share", lambda: rig.camera("wrist").get("depth_measured_share"))
        assert told > MEASURED_SHARE


def test_its_depth_reaches_a_model_and_a_recording_unchanged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    camera, model, file = SoftwareCamera(), Looker(camera="wrist"), tmp_path / "run.mcap"
    monkeypatch.setattr(RealsenseSource.__init__, "__defaults__", (lambda _: camera.device,))
    with camera_rig({"wrist": profile(depth_unit_m=UNIT_M)}) as rig, camera.filming():
        rig.wait_for("wrist", "ok")
        with open_session(rig.profile.session) as session, looking(rig, model) as tell:
            recorder = Recorder(rig.profile, session, file).start()
            await_match(rig.session, rig.profile.keys.camera_depth("wrist"))

            def seen() -> bool:
                tell()
                time.sleep(0.05)
                return len(model.seen) >= 5

            until("the model sees", seen)
            recorder.close()
    kept = {each.stamp_ns: each.depth() for each in depths(open_recording(file), "wrist")}
    both = [each for each in model.seen if each.stamp_wall_ns in kept]
    assert both
    for each in both:
        depth = kept[each.stamp_wall_ns]
        assert depth.unit_m == UNIT_M
        measured = depth.counts > 0
        assert measured.mean() > MEASURED_SHARE
        # The model asked for half millimetres.
        np.testing.assert_array_equal(each.depth["wrist"], 2 * depth.counts)
