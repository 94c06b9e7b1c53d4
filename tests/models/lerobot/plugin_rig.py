"""A simulated SO-101 on the bus, and LeRobot's commands beside it with our plug-in."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from camera_rig import free_endpoint
from chain import Chain, running_chain

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.keys import Kind, worker_node
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.types import GripperState, JointState

ROOT = Path(__file__).parents[3]
PLUGIN = "lerobot_robot_vla_zenoh"
SOURCE = ROOT / "plugins" / PLUGIN / "src"
WIDTH, HEIGHT, CAMERA_HZ, FPS = 160, 120, 20, 10
READY_S = 90.0
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
NAMES = [*(f"{name}.pos" for name in JOINTS), "gripper.pos"]
HOME_DEG = np.degrees([0.0, -0.6, 0.6, 0.8, 0.0])
SWING_DEG, SWING_S = 15.0, 4.0

PROFILE = """\
extends: so101_sim
cameras:
  front: {{source: "sim:front", width: {width}, height: {height}, rate_hz: {camera_hz}}}
  wrist: null
task: {{prompt: hold, rate_hz: {fps}, worker: scripted_pick}}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing:
  {{command_timeout_s: 1.0, state_timeout_s: 2.0, watchdog_s: 2.0, max_observation_age_s: 5.0}}
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


def write_leader(folder: Path, arm: Chain) -> Path:
    """Profile of a second arm at the same router."""
    path = folder / "leader.yaml"
    path.write_text(f"extends: {arm.profile_file}\nrobot: {{name: leader}}\n")
    return path


class Leader:
    """States of a second arm whose pan swings, as its driver would publish them."""

    def __init__(self, profile: Profile) -> None:
        self.profile = as_robot(profile, "leader")
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Leader:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        with open_session(self.profile.session) as session:
            node = Node("arm", self.profile, session)
            keys = node.keys
            joint = node.declare_publisher(keys.state_joint, Kind.STATE)
            gripper = node.declare_publisher(keys.state_gripper, Kind.STATE)
            home_rad, still = np.radians(HOME_DEG), np.zeros(len(JOINTS))
            began_s = time.monotonic()
            while not self._end.wait(0.02):
                passed = (time.monotonic() - began_s) / SWING_S
                at_rad = home_rad.copy()
                at_rad[0] = math.radians(SWING_DEG) * math.sin(2 * math.pi * passed)
                joint.publish(JointState(JOINTS, at_rad, still, None))
                gripper.publish(GripperState(0.05, moving=False, holding=False))
            node.close()


def install(site: Path) -> None:
    """What an installer leaves of the plug-in: LeRobot looks for its name."""
    about = site / f"{PLUGIN}-0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PLUGIN}\nVersion: 0\n")
    (site / PLUGIN).symlink_to(SOURCE / PLUGIN)


def lerobot(site: Path, script: str, *words: str) -> None:
    """Run a command of LeRobot, such as ``record``, where the plug-in is installed.

    In this process: to import LeRobot anew takes longer than the command.
    """
    command = import_module(f"lerobot.scripts.lerobot_{script}")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        patch.setattr(sys, "argv", [f"lerobot-{script}", *words])
        command.main()
