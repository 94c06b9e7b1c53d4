"""A profile for two computers: both parts as ``vla-zenoh up --host``, here on one."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from camera_rig import free_endpoint, until
from chain import READY_PATIENCE_S, Recorder, write_profile

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import load_profile

pytestmark = pytest.mark.long

STEPS, STEP_M, TOLERANCE_M = 5, 0.01, 0.001
END_S = 20.0
HOSTS = """\
hosts:
  robot: {{nodes: [router, sim, camera, command]}}
  gpu: {{nodes: [worker], connect: ["{endpoint}"]}}
"""
"""As shipped, at a free port."""


@contextmanager
def up(path: Path, host: str) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-m", "vla_zenoh", "up", str(path), "--host", host, "--no-record"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=END_S)
        finally:
            process.kill()


def test_models_on_another_host_get_jpeg_and_move_the_arm(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = write_profile(
        tmp_path,
        extends="panda_sim_two_hosts",
        endpoint=endpoint,
        more=HOSTS.format(endpoint=endpoint),
    )
    profile = load_profile(str(path))
    with (
        up(path, "robot") as robot,
        open_session(profile.session, wait_s=READY_PATIENCE_S) as session,
    ):
        client = Client(profile, session).subscribe()
        recorder = Recorder(session, profile.keys)
        until(
            "the robot's nodes",
            lambda: client.alive == {"router", "sim", "camera", "command"},
            READY_PATIENCE_S,
        )
        with up(path, "gpu") as gpu:
            until("the worker", lambda: "worker-scripted" in client.alive, READY_PATIENCE_S)
            until("the task is said", lambda: client.task is not None, READY_PATIENCE_S)

            def activated() -> bool:
                try:
                    return client.activate().active
                except SessionError:
                    return False

            until("an active arm", activated, READY_PATIENCE_S)
            state = until("a pose", recorder.newest_state)
            assert state.reference_position_m is not None
            start_m = state.reference_position_m[2]
            client.set_prompt(f"HARD: go up x{STEPS}")

            def arrived() -> bool:
                now = recorder.newest_state()
                assert now is not None
                assert now.reference_position_m is not None
                way_m = now.reference_position_m[2] - start_m
                return abs(way_m - STEPS * STEP_M) < TOLERANCE_M and np.abs(now.twist).max() < 0.01

            until(f"{STEPS} steps", arrived, READY_PATIENCE_S)
            camera = client.status("camera")
            assert camera is not None
            assert camera.counters["front.jpeg"] > 0
            assert camera.counters["front.raw"] == 0
        assert gpu.returncode == 0
        # The models' host went: the arm obeys nobody, and the robot's host goes on.
        until("inactive", lambda: (s := client.status("command")) and s.state == "inactive")
        assert robot.poll() is None
    assert robot.returncode == 0
