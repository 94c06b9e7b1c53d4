"""The programs of examples/ do what their first lines say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import pytest
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain, command_line

import vla_zenoh

EXAMPLES = Path(__file__).parents[2] / "examples"
MOVED_M = 0.04
ROBOT_PATIENCE_S = LONG_PATIENCE_S


def run(name: str, *arguments: str, folder: Path, timeout_s: float = 60) -> str:
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "MPLBACKEND": "Agg"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def profile_file(chain: Chain) -> str:
    return str(chain.profile_file)


def test_the_arm_is_driven_from_python(chain: Chain, tmp_path: Path) -> None:
    text = run("drive_from_python.py", profile_file(chain), folder=tmp_path)
    heights_m = [float(found) for found in re.findall(r"z = ([\d.]+) m", text)]
    assert heights_m[-1] - heights_m[0] > MOVED_M
    assert "the arm stands" in text
    assert chain.state() == "inactive"


def test_a_program_stops_the_arm_and_resets_it(chain: Chain) -> None:
    chain.move()
    with vla_zenoh.connect(chain.profile) as robot:
        robot.stop()
        chain.until("it is stopped", lambda: chain.state() == "stopped")
        with pytest.raises(vla_zenoh.SessionError, match="emergency stop"):
            robot.activate()
        robot.reset()
        chain.until("it is reset", lambda: chain.state() == "inactive")
        assert robot.chunk("scripted").record.worker == "scripted"


def test_a_stream_without_publisher_is_an_error_with_its_key(chain: Chain) -> None:
    with (
        vla_zenoh.connect(chain.profile) as robot,
        pytest.raises(vla_zenoh.SessionError, match="camera/nowhere/raw"),
    ):
        robot.image("nowhere", timeout_s=0.2)


def test_images_are_received_and_the_last_one_is_saved(chain: Chain, tmp_path: Path) -> None:
    text = run("subscribe_to_camera.py", profile_file(chain), "front", folder=tmp_path)
    assert text.count(" ms old") == 30
    image = cv2.imread(str(tmp_path / "front.png"))
    assert image is not None
    assert image.any()


def test_the_arm_is_driven_by_the_zenoh_package_alone(chain: Chain, tmp_path: Path) -> None:
    (endpoint,) = chain.profile.session.connect
    before_m = chain.height_m()
    root = f"{chain.profile.root}/{chain.profile.robot.name}"
    text = run("plain_zenoh.py", endpoint, root, folder=tmp_path)
    assert "prompt: HARD: go up x10" in text
    assert chain.height_m() - before_m > MOVED_M


@pytest.mark.long
def test_a_recording_is_evaluated_and_plotted(chain: Chain, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    words = ("record", "--profile", profile_file(chain), "--output", str(file), "--seconds", "20")
    recording = threading.Thread(target=command_line, args=words)
    recording.start()
    try:
        chain.until(
            "the recorder is alive", lambda: "recorder" in chain.client.alive, READY_PATIENCE_S
        )
        chain.activate_when_ready()
        chain.go("up", 10)
    finally:
        recording.join()
    text = run("evaluate_and_plot.py", str(file), folder=tmp_path)
    assert float(re.findall(r"path of the TCP: ([\d.]+) m", text)[0]) > MOVED_M
    assert "p95" in text
    assert cv2.imread(str(tmp_path / "height.png")) is not None


@pytest.mark.slow
def test_two_hosts_move_the_arm(tmp_path: Path) -> None:
    text = run("two_hosts.py", folder=tmp_path, timeout_s=120)
    assert "z = " in text
