"""A simulated SO-101 on the bus, and LeRobot's commands beside it with our plug-in."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_rig import free_endpoint
from chain import Chain, running_chain

from vla_zenoh.keys import worker_node

ROOT = Path(__file__).parents[3]
PLUGIN = "lerobot_robot_vla_zenoh"
SOURCE = ROOT / "plugins" / PLUGIN / "src"
WIDTH, HEIGHT, CAMERA_HZ, FPS = 160, 120, 20, 10
COMMAND_S, READY_S = 120.0, 90.0

PROFILE = """\
extends: so101_sim
cameras:
  front: {{source: "sim:front", width: {width}, height: {height}, rate_hz: {camera_hz}}}
  wrist: null
task: {{prompt: hold, rate_hz: {fps}, worker: scripted_pick}}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing: {{command_timeout_s: 0.5, state_timeout_s: 1.0, watchdog_s: 1.0}}
"""


def write_profile(folder: Path, name: str = "so101", **changes: str) -> Path:
    """A simulated SO-101 with one small camera, at a port of its own."""
    path = folder / f"{name}.yaml"
    given = {"endpoint": free_endpoint(), **changes}
    path.write_text(
        PROFILE.format(width=WIDTH, height=HEIGHT, camera_hz=CAMERA_HZ, fps=FPS, **given)
    )
    return path


@contextmanager
def running_arm(folder: Path) -> Iterator[Chain]:
    """The arm with camera, command node and the worker scripted_pick."""
    with running_chain(folder, profile_file=write_profile(folder)) as chain:
        worker = worker_node("scripted_pick")
        chain.until("images come", lambda: chain.state(worker) == "inferring", READY_S)
        yield chain


def install(site: Path) -> None:
    """What an installer leaves of the plug-in: LeRobot looks for its name."""
    about = site / f"{PLUGIN}-0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PLUGIN}\nVersion: 0\n")
    (site / PLUGIN).symlink_to(SOURCE / PLUGIN)


def lerobot(site: Path, script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of LeRobot, such as ``record``, where the plug-in is installed."""
    path = [str(site), *filter(None, [os.environ.get("PYTHONPATH"), str(ROOT / "src")])]
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(path), "HF_HUB_OFFLINE": "1"}
    command = [sys.executable, "-m", f"lerobot.scripts.lerobot_{script}", *words]
    return subprocess.run(
        command, env=environ, capture_output=True, text=True, check=False, timeout=COMMAND_S
    )
