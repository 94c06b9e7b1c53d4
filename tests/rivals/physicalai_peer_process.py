"""Runs in the environment of physicalai: its own owner with an arm of ours, or its own client.

    python physicalai_peer_process.py owner NAME [Arm | WidowX]      # until its standard input ends
    python physicalai_peer_process.py client NAME     # a line of JSON in, a line of JSON out

The owner's arm is at once where it is sent. A client's lines: ``{"act": [...]}`` sends an action;
every line is answered with the newest observation.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]


class Arm:
    """A robot as physicalai's drivers are; in normalised units."""

    joint_names = NAMES
    device_ids = ("serial:of-a-test",)

    def __init__(self) -> None:
        self.at = np.array([0.0, -20.0, 20.0, 10.0, 0.0, 30.0])

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def is_connected(self) -> bool:
        return True

    def get_observation(self) -> Any:
        return SimpleNamespace(
            joint_positions=self.at.copy(),
            state=self.at.copy(),
            timestamp=time.monotonic(),
            sensor_data=None,
            images=None,
        )

    def send_action(self, action: Any, *, goal_time: float = 0.1) -> None:
        self.at = np.array(action)


class WidowX(Arm):
    """One of six joints and a gripper, in degrees and m."""

    joint_names = (*(f"joint_{number}" for number in range(6)), "gripper")

    def __init__(self) -> None:
        self.at = np.array([0.0, 68.755, 57.296, -22.918, 0.0, 0.0, 0.02])


def own(name: str, arm: str = "Arm") -> None:
    """Own a robot with physicalai's owner."""
    transport = import_module("physicalai.robot.transport")
    stop = threading.Event()
    reader = threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True)
    reader.start()
    recipe = {"class_path": f"physicalai_peer_process.{arm}", "init_args": {}}
    config = transport.RobotOwnerConfig(name=name, robot=recipe, rate_hz=100.0, idle_timeout=None)
    transport.run_owner(config, stop, ready=lambda: print("READY", flush=True))


def ask(name: str) -> None:
    """Be physicalai's client of a robot."""
    robot = import_module("physicalai.robot.transport").SharedRobot.attach(name)
    robot.connect()
    print(json.dumps({"joint_names": robot.joint_names}), flush=True)
    for line in sys.stdin:
        action = json.loads(line).get("act")
        if action is not None:
            robot.send_action(np.array(action))
        seen = robot.get_observation()
        told = {"positions": list(map(float, seen.joint_positions)), "timestamp": seen.timestamp}
        print(json.dumps(told), flush=True)
    robot.disconnect()


if __name__ == "__main__":
    {"owner": own, "client": ask}[sys.argv[1]](*sys.argv[2:])
