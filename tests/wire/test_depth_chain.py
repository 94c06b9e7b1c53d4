"""Depth of a scene of known geometry: from the simulator over the wire into a recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from camera_rig import Rig, await_match, camera_rig, until
from chain import READY_PATIENCE_S
from depth_rig import Looker, looking

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_depth
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import depths
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.simulation.robot_model import robot_model
from vla_zenoh.simulation.scene import build_model
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import Depth, Header, SceneState

pytestmark = pytest.mark.long

LIMIT_M = 0.001
CAMERAS = {
    "front": CameraProfile(
        source="sim:front", width=320, height=240, rate_hz=30, depth_unit_m=0.001
    )
}
PATCH_M = ((0.10, -0.55), (0.60, -0.30))
"""A part of the table top, which is z = 0, on which and before which nothing stands."""


class Stage:
    """Plays the simulator."""

    def __init__(self, rig: Rig) -> None:
        self._publisher = rig.watcher.declare_publisher(rig.profile.keys.sim_scene)
        self._qpos, self._seq = build_world(rig.profile).qpos(), 0
        until("a listener", lambda: self._publisher.matching_status.matching)

    def show(self) -> None:
        payload = records.encode(SceneState("table", self._qpos))
        header = records.encode_header(Header(time.time_ns(), self._seq, "sim#test"))
        self._publisher.put(payload, attachment=header)
        self._seq += 1
        time.sleep(1 / 30)

    def show_until(self, what: str, enough: Callable[[], bool]) -> None:
        def shown() -> bool:
            if not enough():
                self.show()
            return enough()

        until(what, shown, READY_PATIENCE_S)


def assert_plane(rig: Rig, depth: Depth) -> None:
    """The table top in a depth picture, by the intrinsics that the camera tells."""
    told = [one.detail["cameras"] for one in rig.statuses if "cameras" in one.detail]
    seen = told[-1]["front"]["intrinsics"]
    model = build_model(rig.profile.sim.scene, [robot_model(rig.profile.robot)])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = data.camera("front")
    position_m, axes = camera.xpos, camera.xmat.reshape(3, 3)
    rows, columns = np.indices(depth.counts.shape)
    x = (columns + 0.5 - seen["cx_px"]) / seen["fx_px"]
    y = (rows + 0.5 - seen["cy_px"]) / seen["fy_px"]
    rays = np.stack([x, -y, -np.ones_like(x)], axis=-1) @ axes.T
    true_m = -position_m[2] / rays[..., 2]
    hit = position_m + true_m[..., None] * rays
    (low_x, low_y), (high_x, high_y) = PATCH_M
    on_table = (hit[..., 0] > low_x) & (hit[..., 0] < high_x) & (true_m > 0)
    on_table &= (hit[..., 1] > low_y) & (hit[..., 1] < high_y)
    assert on_table.sum() > 1000
    measured_m = depth.counts * depth.unit_m
    assert np.abs(measured_m - true_m)[on_table].max() < LIMIT_M
    points = (position_m + measured_m[..., None] * rays)[on_table]
    assert np.abs(points[:, 2]).max() < LIMIT_M
    # The plane through them, by least squares.
    *_, normal = np.linalg.svd(points - points.mean(axis=0))[2]
    tilt_m = np.hypot(*normal[:2]) * np.ptp(points[:, :2], axis=0).max()
    assert abs(points.mean(axis=0)[2]) < LIMIT_M
    assert tilt_m < LIMIT_M


def test_a_plane_is_within_a_millimetre_after_wire_and_recording(tmp_path: Path) -> None:
    with camera_rig(CAMERAS) as rig:
        stage = Stage(rig)
        key = rig.profile.keys.camera_depth("front")
        heard, subscriber = rig.listen(key)
        with open_session(rig.profile.session) as session:
            recorder = Recorder(rig.profile, session, tmp_path / "run.mcap").start()
            await_match(rig.session, key)
            stage.show_until("pictures of depth", lambda: len(heard) >= 10)
            recorder.close()
        subscriber.undeclare()
        kind, _, schema = heard[-1].encoding.partition(";")
        assert kind == "image/png"
        assert_plane(rig, decode_depth(heard[-1].payload, schema))
        kept = dict(
            (sample.header.seq, sample.depth())
            for sample in depths(open_recording(tmp_path / "run.mcap"), "front")
            if sample.header is not None
        )
        assert kept
        for frame in heard:
            if frame.header.seq in kept:
                depth = decode_depth(frame.payload, frame.encoding.partition(";")[2])
                np.testing.assert_array_equal(kept[frame.header.seq].counts, depth.counts)
        assert_plane(rig, list(kept.values())[-1])


def test_nobody_who_asks_for_depth_costs_no_depth() -> None:
    with camera_rig(CAMERAS) as rig:
        stage = Stage(rig)
        colour, _one = rig.listen(rig.profile.keys.camera_raw("front"))
        stage.show_until("pictures", lambda: len(colour) >= 5)
        time.sleep(0.6)
        assert rig.counter("front.raw") >= 5
        assert rig.counter("front.depth") == 0


def test_a_model_gets_the_depth_of_its_picture_and_shows_it_as_it_got_it() -> None:
    model = Looker()
    with camera_rig(CAMERAS) as rig:
        shown, _one = rig.listen(rig.profile.keys.seen_depth("looker", "front"))
        stage = Stage(rig)
        with looking(rig, model) as tell:
            stage.show_until("what it saw", lambda: tell() or len(shown) >= 3)
        by_stamp = {seen.stamp_wall_ns: seen for seen in model.seen}
        for frame in shown:
            depth = decode_depth(frame.payload, frame.encoding.partition(";")[2])
            assert depth.unit_m == 0.0005
            given = by_stamp[frame.header.stamp_wall_ns].depth["front"]
            np.testing.assert_array_equal(depth.counts, given)
            assert depth.counts.max() * depth.unit_m <= 3.0
            # Infinitely far and further than the model takes: not measured, as it declared.
            assert (depth.counts == 0).any()
        assert_plane(rig, Depth(model.seen[-1].depth["front"], 0.0005))


def test_a_slow_model_gets_a_history_of_what_came_while_it_was_thinking() -> None:
    model = Looker(0.4, history=3, history_spacing_s=0.2, max_skew_s=0.1)
    with camera_rig(CAMERAS) as rig, looking(rig, model) as tell:
        Stage(rig).show_until("it saw enough", lambda: tell() or len(model.seen) >= 6)
    assert len(model.seen) == 6
    first = model.seen[0]
    assert [each.stamp_wall_ns for each in first.history] == [first.stamp_wall_ns] * 2
    for seen in model.seen[2:]:
        stamps = [each.stamp_wall_ns for each in (*seen.history, seen)]
        apart_s = np.diff(stamps) / 1e9
        assert np.abs(apart_s - 0.2).max() <= 0.2, "each within 0.1 s of its time"
        assert stamps == sorted(set(stamps))
        assert all(each.depth["front"].any() for each in seen.history)
