"""Network cameras that stall, vanish and want a password, against a real RTSP server."""

from __future__ import annotations

import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from camera_rig import camera_rig, until, write_video
from rtsp_server import RtspServer

from vla_zenoh.errors import NodeError
from vla_zenoh.nodes.camera.opencv_sources import RtspSource
from vla_zenoh.nodes.camera.source import STALL_S, prepare_opencv
from vla_zenoh.profile.schema import CameraProfile

pytestmark = pytest.mark.long

RATE_HZ, LENGTH_S = 25, 2.0
COLOUR_TOLERANCE = 12  # of 255, MPEG-2
LEFT_OUT = 0.25
"""Of the pictures: what a busy computer may miss."""
STOP_S = 0.5
ORANGE_RGB = (200, 120, 20)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A transport stream; its left half is orange, the right one noise, to make it large enough."""
    path = tmp_path_factory.mktemp("video") / "stream.ts"
    noise = np.random.default_rng(0).integers(0, 255, (50, 120, 80, 3)).astype(np.uint8)
    orange = np.full((120, 80, 3), ORANGE_RGB[::-1], np.uint8)
    pictures = [np.concatenate([orange, right], axis=1) for right in noise]
    write_video(path, pictures, RATE_HZ, code="mpg2")
    return path


def camera(server: RtspServer, user: str = "") -> CameraProfile:
    source = f"rtsp://{user}127.0.0.1:{server.port}/cam"
    return CameraProfile(source=source, width=160, height=120, rate_hz=60)


@pytest.mark.slow
def test_a_stream_is_shown_as_it_comes_and_survives_a_stall_and_a_restart(video: Path) -> None:
    with RtspServer(video, LENGTH_S) as server:
        rig_context = camera_rig({"net": camera(server)})
        with rig_context as rig:
            frames, _ = rig.listen(rig.profile.keys.camera_raw("net"))
            until("two seconds of it", lambda: len(frames) > 2 * RATE_HZ)
            stamps = np.array([frame.header.stamp_wall_ns for frame in frames])
            assert np.mean(np.diff(stamps)) / 1e9 == pytest.approx(1 / RATE_HZ, rel=LEFT_OUT)
            difference = frames[-1].rgb[60, 40].astype(int) - ORANGE_RGB
            assert abs(difference).max() <= COLOUR_TOLERANCE
            assert rig.camera("net")["backend"] == "FFMPEG"

            server.silent.set()
            began = time.monotonic()
            rig.wait_for("net", "lost")
            assert time.monotonic() - began < STALL_S + 1.0
            server.silent.clear()
            rig.wait_for("net", "ok")
            assert rig.counter("net.losses") == 1

            server.__exit__(None, None, None)
            rig.wait_for("net", "lost")
            with RtspServer(video, LENGTH_S, port=server.port):
                rig.wait_for("net", "ok")
                count = len(frames)
                until("more pictures", lambda: len(frames) > count + RATE_HZ)


def test_the_password_is_used_and_never_shown(video: Path) -> None:
    with (
        RtspServer(video, LENGTH_S, credentials="me:hush") as server,
        camera_rig({"net": camera(server, "me:hush@"), "locked": camera(server)}) as rig,
    ):
        rig.wait_for("net", "ok")
        until("a reason", lambda: "password right" in rig.camera("locked").get("why", ""))
        told = repr([rig.statuses, rig.events])
        assert "hush" not in told
        assert f"rtsp://127.0.0.1:{server.port}/cam" in told


def test_a_stalled_stream_is_noticed_in_time(video: Path) -> None:
    prepare_opencv()
    with RtspServer(video, LENGTH_S) as server:
        source = RtspSource(f"rtsp://127.0.0.1:{server.port}/cam")
        source.open()
        stop = threading.Event()
        for _ in range(RATE_HZ):
            source.grab(stop)
        server.silent.set()
        began = time.monotonic()
        with pytest.raises(NodeError, match="sent nothing for 2 s"):
            grab_for(source, 3 * STALL_S)
        assert time.monotonic() - began < STALL_S + 0.5
        source.close()


def grab_for(source: RtspSource, duration_s: float) -> None:
    give_up = time.monotonic() + duration_s
    while time.monotonic() < give_up:
        source.grab(threading.Event())


def test_a_camera_that_hangs_while_it_is_opened_does_not_hold_up_the_end() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        source = f"rtsp://127.0.0.1:{deaf.getsockname()[1]}/cam"
        with camera_rig({"net": CameraProfile(source=source)}) as rig:
            time.sleep(0.5)
            assert rig.camera("net")["state"] == "waiting"
            began = time.monotonic()
            rig.stop.set()
            rig.thread.join(5.0)
            assert time.monotonic() - began < STOP_S
