"""The camera node on a real bus: what arrives, when, and what it costs when nobody listens."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from camera_rig import Rig, await_match, camera_rig, grey, until, write_video

from vla_zenoh.codec import message, records
from vla_zenoh.codec.image import decode_raw
from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.node import IDLE_PERIOD_S
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.simulation.backend import VARIABLE
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import Header, SceneState

JPEG_TOLERANCE = 6  # of 255, within a patch of one colour
STOP_S = 0.5
FRESH_S = 0.3
SLOW_READER_S = 0.1
STILL_SCENE_S = 6
"""Longer than any source with noise may show the very same picture."""
RATE_TOLERANCE = 0.1
COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "skin": (224, 172, 105)}

pytestmark = pytest.mark.realtime


def colour_chart(width: int = 64, height: int = 48) -> np.ndarray:
    """Four vertical stripes, RGB."""
    chart = np.zeros((height, width, 3), np.uint8)
    for i, colour in enumerate(COLOURS.values()):
        chart[:, i * width // 4 : (i + 1) * width // 4] = colour
    return chart


def write_chart(folder: Path) -> CameraProfile:
    assert cv2.imwrite(str(folder / "chart.png"), colour_chart()[..., ::-1])
    return CameraProfile(source=f"file:{folder}", width=64, height=48, rate_hz=50)


def stripes(rgb: np.ndarray) -> np.ndarray:
    height, width, _ = rgb.shape
    return np.array([rgb[height // 2, (2 * i + 1) * width // 8] for i in range(len(COLOURS))])


# -- what arrives ---------------------------------------------------------------------------------
def test_raw_and_jpeg_of_one_frame_share_stamp_and_number_and_show_the_same(
    tmp_path: Path,
) -> None:
    with camera_rig({"front": write_chart(tmp_path)}) as rig:
        began_ns = time.time_ns()
        raws, _raw = rig.listen(rig.profile.keys.camera_raw("front"))
        jpegs, _jpeg = rig.listen(rig.profile.keys.camera_jpeg("front"))
        until("20 frames of each", lambda: len(raws) > 20 and len(jpegs) > 20)
        numbers = [frame.header.seq for frame in jpegs]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        by_number = {frame.header.seq: frame for frame in raws}
        pairs = [(by_number[f.header.seq], f) for f in jpegs if f.header.seq in by_number]
        assert len(pairs) > 10
        for raw, jpeg in pairs:
            assert raw.header == jpeg.header
            assert began_ns < raw.header.stamp_wall_ns < raw.arrived_ns
        raw, jpeg = pairs[-1]
        assert raw.encoding == "zenoh/bytes;rgb8;48x64"
        assert len(raw.payload) == 48 * 64 * 3
        assert jpeg.encoding == "image/jpeg"
        assert (raw.rgb == colour_chart()).all()
        difference = stripes(jpeg.rgb).astype(int) - list(COLOURS.values())
        assert abs(difference).max() <= JPEG_TOLERANCE


def test_nothing_is_encoded_while_nobody_listens_and_still_the_age_is_known(
    tmp_path: Path,
) -> None:
    with camera_rig({"front": write_chart(tmp_path)}) as rig:
        rig.wait_for("front", "ok")
        count = len(rig.statuses)
        until("two more reports", lambda: len(rig.statuses) >= count + 2)
        assert rig.counter("front.raw") == rig.counter("front.jpeg") == 0
        assert rig.camera("front")["age_s"] < FRESH_S

        frames, subscriber = rig.listen(rig.profile.keys.camera_raw("front"))
        until("frames", lambda: len(frames) > 5)
        until("a count", lambda: rig.counter("front.raw") > 0)
        assert rig.counter("front.jpeg") == 0

        subscriber.undeclare()
        heard = len(rig.statuses)
        until("two reports", lambda: len(rig.statuses) >= heard + 2)
        count = rig.counter("front.raw")
        heard = len(rig.statuses)
        until("two more reports", lambda: len(rig.statuses) >= heard + 2)
        assert rig.counter("front.raw") == count
        assert rig.camera("front")["state"] == "ok"


def test_pictures_of_another_size_are_stretched_and_told_once(tmp_path: Path) -> None:
    profile = write_chart(tmp_path).model_copy(update={"width": 100, "height": 40})
    with camera_rig({"front": profile}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("frames", lambda: len(frames) > 20)
        assert frames[-1].rgb.shape == (40, 100, 3)
        assert (stripes(frames[-1].rgb) == list(COLOURS.values())).all()
        until("a count", lambda: rig.counter("front.resized") > 10)
        (event,) = rig.happened("front:resized")
        assert "64x48" in event.why
        assert "100x40" in event.why


# -- files ----------------------------------------------------------------------------------------
def test_a_video_plays_at_its_own_rate_and_starts_again(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    write_video(path, [grey(20 * i) for i in range(8)], rate_hz=20)
    profile = CameraProfile(source=f"file:{path}", width=64, height=48, rate_hz=60)
    with camera_rig({"front": profile}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("three rounds", lambda: len(frames) > 24)
        levels = [round(int(frame.rgb[24, 32, 0]) / 20) for frame in frames]
        steps = np.diff(levels) % 8
        gaps_s = np.diff([frame.header.stamp_wall_ns for frame in frames]) / 1e9
        # Pictures are left out only where a busy computer let their time pass.
        late = (steps > 1) & (gaps_s > 0.75 * steps / 20)
        assert ((steps == 1) | late).all(), (levels, gaps_s)
        rate_hz = 1.0 / float(np.median(gaps_s))
        assert rate_hz == pytest.approx(20, rel=RATE_TOLERANCE)
        told_hz = pytest.approx(20, rel=2 * RATE_TOLERANCE)
        until("it is told", lambda: rig.statuses[-1].rates_hz["front"] == told_hz)
        assert rig.camera("front")["backend"] == "FFMPEG"


def test_a_faster_video_is_thinned_to_the_rate_not_slowed(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    write_video(path, [grey(2 * i) for i in range(100)], rate_hz=50)
    profile = CameraProfile(source=f"file:{path}", width=64, height=48, rate_hz=10)
    with camera_rig({"front": profile}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("a second of it", lambda: len(frames) > 10)
        levels = [round(int(frame.rgb[24, 32, 0]) / 2) for frame in frames]
        assert np.median(np.diff(levels) % 100) == 5
        assert min(np.diff([frame.header.stamp_wall_ns for frame in frames])) > 0.05e9


# -- several cameras, readers, the end ------------------------------------------------------------
def test_one_node_serves_the_cameras_it_is_given_and_no_others(tmp_path: Path) -> None:
    chart = write_chart(tmp_path)
    cameras = {"a": chart, "b": chart, "c": chart, "d": CameraProfile(source="ros2:/d")}
    with camera_rig(cameras, name="camera-left", cameras=("a", "c")) as rig:
        rig.wait_for("a", "ok")
        rig.wait_for("c", "ok")
        assert set(rig.statuses[-1].detail["cameras"]) == {"a", "c"}
        assert rig.statuses[-1].node == "camera-left"
        assert rig.statuses[-1].state == "running"


def test_a_camera_that_is_not_in_the_profile_is_refused_before_anything_starts() -> None:
    with (
        pytest.raises(NodeError, match=r"no camera 'top'.*front, wrist"),
        camera_rig(load_profile("panda_sim").cameras, cameras=("top",)),
    ):
        pass


def test_a_slow_reader_never_gets_old_frames(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    assert cv2.imwrite(str(tmp_path / "noise.bmp"), noise)
    profile = CameraProfile(source=f"file:{tmp_path}", rate_hz=30)
    with camera_rig({"front": profile}) as rig:
        reader = rig.watcher.declare_subscriber(
            rig.profile.keys.camera_raw("front"), zenoh.handlers.RingChannel(1)
        )
        ages_s = []
        for _ in range(20):
            sample = reader.recv()
            assert sample.attachment is not None
            stamp_ns = records.decode_header(sample.attachment.to_bytes()).stamp_wall_ns
            ages_s.append((time.time_ns() - stamp_ns) / 1e9)
            decode_raw(sample.payload.to_bytes(), "rgb8;480x640")
            time.sleep(SLOW_READER_S)
        assert max(ages_s) < FRESH_S
        assert rig.camera("front")["age_s"] < FRESH_S


def test_the_node_ends_in_time_and_says_goodbye(tmp_path: Path) -> None:
    cameras = {
        "file": write_chart(tmp_path),
        "slow": CameraProfile(source=f"file:{tmp_path}", rate_hz=0.1),
        "device": CameraProfile(source="v4l2:97"),
        "sim": CameraProfile(source="sim:front", width=64, height=48),
    }
    with camera_rig(cameras) as rig:
        rig.wait_for("file", "ok")
        began = time.monotonic()
        rig.stop.set()
        rig.thread.join(5.0)
        assert time.monotonic() - began < STOP_S
        left = {thread.name for thread in threading.enumerate()}
        assert not left & {f"camera {name}" for name in cameras}
        until("a last word", lambda: rig.statuses[-1].state == "ended")
        alive = rig.watcher.liveliness().get(rig.profile.keys.all_alive, timeout=1.0)
        assert [reply for reply in alive if reply.ok is not None] == []


# -- the simulated scene --------------------------------------------------------------------------
SMALL = {
    "front": CameraProfile(source="sim:front", width=160, height=120, rate_hz=30),
    "wrist": CameraProfile(source="sim:wrist", width=96, height=96, rate_hz=30),
}


class Stage:
    """Plays the simulator: publishes scenes, or what is no scene."""

    def __init__(self, rig: Rig) -> None:
        world = build_world(rig.profile)
        self.qpos = world.qpos()
        world.reset(7)
        self.other_qpos = world.qpos()
        self._publisher = rig.watcher.declare_publisher(rig.profile.keys.sim_scene)
        self._seq = 0
        until("a listener", lambda: self._publisher.matching_status.matching)

    def show(self, scene: SceneState, stamp_ns: int) -> None:
        self.put(records.encode(scene), stamp_ns)

    def put(self, payload: bytes, stamp_ns: int = 1) -> None:
        header = records.encode_header(Header(stamp_ns, self._seq, "sim#test"))
        self._publisher.put(payload, attachment=header)
        self._seq += 1


def test_a_scene_is_drawn_once_with_its_own_stamp_for_every_camera() -> None:
    with camera_rig(SMALL) as rig:
        stage = Stage(rig)
        heard = {}
        for camera in SMALL:
            key = rig.profile.keys.camera_raw(camera)
            heard[camera] = rig.listen(key)
            await_match(rig.session, key)
        until("a renderer", lambda: rig.statuses[-1].detail["renderer"] == "raycast")
        # Stamps of a simulation in lockstep: they have nothing to do with any clock.
        shown = [5_000_000_000 + i * 1_000_000_000 for i in range(4)]
        for i, stamp_ns in enumerate(shown):
            stage.show(SceneState("table", (stage.qpos, stage.other_qpos)[i % 2]), stamp_ns)
            time.sleep(0.5)
        time.sleep(IDLE_PERIOD_S)
        for camera, (frames, _) in heard.items():
            # On a busy computer shared memory may lose a frame; none may come twice or be of an
            # instant that was never shown.
            stamps = [frame.header.stamp_wall_ns for frame in frames]
            assert len(stamps) >= 2
            assert stamps == sorted(set(stamps) & set(shown))
            assert rig.counter(f"{camera}.raw") <= len(shown)
            settings = SMALL[camera]
            assert frames[0].rgb.shape == (settings.height, settings.width, 3)
        by_stamp = {frame.header.stamp_wall_ns: frame.rgb for frame in heard["front"][0]}
        one, *others = (by_stamp[stamp] for stamp in sorted(by_stamp))
        assert any((one != other).any() for other in others), "objects were moved"
        assert rig.camera("front")["backend"].startswith("raycast")


def test_a_simulated_camera_is_fresh_while_scenes_come_and_lost_when_they_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(VARIABLE)  # as shipped: it looks which renderer works here
    with camera_rig(SMALL, renderer="auto") as rig:
        stage = Stage(rig)
        rig.wait_for("front", "waiting")
        give_up = time.monotonic() + 8.0
        while rig.camera("front").get("state") != "ok" and time.monotonic() < give_up:
            stage.show(SceneState("table", stage.qpos), time.time_ns())
            time.sleep(1 / 60)
        for _ in range(60):
            stage.show(SceneState("table", stage.qpos), time.time_ns())
            time.sleep(1 / 60)
        assert rig.camera("wrist")["state"] == "ok"
        assert rig.camera("wrist")["age_s"] < FRESH_S
        assert rig.counter("front.raw") == 0
        renderer = rig.statuses[-1].detail["renderer"]
        assert renderer == "egl" or renderer.startswith("raycast, since egl: ")
        told = rig.wait_for("front", "lost")
        assert "sim/scene" in told["why"]
        assert rig.happened("front:ok->lost")
        stage.show(SceneState("table", stage.qpos), time.time_ns())
        rig.wait_for("front", "ok")


@pytest.mark.long
def test_a_scene_that_stands_still_is_no_frozen_camera() -> None:
    with camera_rig(SMALL) as rig:
        stage = Stage(rig)
        heard = [rig.listen(rig.profile.keys.camera_raw(camera)) for camera in SMALL]
        until("a renderer", lambda: rig.statuses[-1].detail["renderer"] == "raycast")
        give_up = time.monotonic() + STILL_SCENE_S
        while time.monotonic() < give_up:
            stage.show(SceneState("table", stage.qpos), time.time_ns())
            time.sleep(1 / 30)
        assert all(len(frames) > STILL_SCENE_S for frames, _ in heard)
        assert not any("bad" in rig.camera(camera) for camera in SMALL)
        assert rig.statuses[-1].state == "running"


def test_what_is_no_scene_of_ours_is_refused_and_counted_and_the_node_lives_on() -> None:
    with camera_rig(SMALL) as rig:
        stage = Stage(rig)
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("a renderer", lambda: rig.statuses[-1].detail["renderer"] == "raycast")
        good = records.encode(SceneState("table", stage.qpos))
        cases = {
            "malformed": message.pack({"scene": "table"}),
            "invalid": records.encode(SceneState("table", stage.qpos[:-1])),
            "foreign_scene": records.encode(SceneState("kitchen", stage.qpos)),
        }
        for reason, payload in cases.items():
            stage.put(payload, time.time_ns())
            until(reason, lambda reason=reason: rig.counter(f"refused.{reason}") == 1)
        for payload in (b"", b"\xff" * 100, good[: len(good) // 2]):
            refused = sum(
                count for name, count in rig.statuses[-1].counters.items() if "refused" in name
            )
            stage.put(payload, time.time_ns())
            until(
                f"a refusal of {payload[:4]!r}",
                lambda refused=refused: (
                    sum(n for name, n in rig.statuses[-1].counters.items() if "refused" in name)
                    > refused
                ),
            )
        assert frames == []
        stage.put(good, 77)
        until("a picture", lambda: frames)
        assert frames[0].header.stamp_wall_ns == 77


def test_a_camera_the_scene_lacks_names_those_it_has() -> None:
    cameras = {"top": CameraProfile(source="sim:top", width=64, height=48), **SMALL}
    with camera_rig(cameras) as rig:
        until("a renderer", lambda: rig.statuses[-1].detail["renderer"] == "raycast")
        until("the reason", lambda: "no camera 'top'" in rig.camera("top")["why"])
        assert "front, " in rig.camera("top")["why"]
        assert rig.statuses[-1].state == "degraded"
