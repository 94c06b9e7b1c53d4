"""The environment with ROS 2's rclpy, as far as it can be judged without one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SIDE = ROOT / "tests" / "ros2" / "ros_side"
PIN = re.compile(r"[a-z0-9-]+==[0-9][0-9.]*")
NEEDED = ("rclpy", "rmw-fastrtps-cpp", "sensor-msgs", "rosidl-default-generators")


@pytest.mark.parametrize("distribution", ["jazzy", "kilted"])
def test_every_version_is_pinned_and_no_address_is_named(distribution: str) -> None:
    lines = (SIDE / f"{distribution}.txt").read_text().splitlines()
    assert [line for line in lines if not PIN.fullmatch(line)] == []
    named = {line.partition("==")[0] for line in lines}
    assert named >= {f"ros-{distribution}-{name}" for name in NEEDED}
    others = {"jazzy", "kilted"} - {distribution}
    assert not [name for name in named for other in others if name.startswith(f"ros-{other}-")]


def test_an_unknown_distribution_is_no_success() -> None:
    words = [sys.executable, str(ROOT / "scripts" / "ros2_environment.py"), "foxy"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "jazzy" in done.stderr
