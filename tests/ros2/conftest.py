"""What the tests with a real bridge share, and why they are skipped where it is missing."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from chain import CHAIN_PATIENCE_S

if TYPE_CHECKING:
    from rclpy_rig import RosLab
    from rig import Lab

# Imports of what needs cyclonedds stand inside: the tests say by themselves why they are skipped.


@pytest.fixture(scope="session")
def bridge_program() -> Path:
    """The bridge, or the reason why this test is skipped."""
    from bridge import load_script

    program = load_script().find_bridge()
    if program is None:
        pytest.skip("no zenoh-bridge-ros2dds: neither on PATH nor built (make ros2-bridge)")
    return program


@pytest.fixture(scope="module")
def shared_lab(tmp_path_factory: pytest.TempPathFactory, bridge_program: Path) -> Iterator[Lab]:
    """One lab for all tests of a file; take `lab` instead, which begins in order."""
    from rig import running_lab

    with running_lab(tmp_path_factory.mktemp("lab"), bridge_program) as lab:
        lab.chain.activate_when_ready()
        yield lab


@pytest.fixture
def lab(shared_lab: Lab) -> Lab:
    """The file's lab: inactive, the arm stands, nothing recorded, no event unread."""
    shared_lab.settle()
    return shared_lab


# -- with ROS 2's own rclpy: nothing of it is skipped, `make test-ros2` brings it ----------------
@pytest.fixture(
    scope="session", params=os.environ.get("ROS2_DISTRIBUTIONS", "jazzy").split() or ["jazzy"]
)
def distribution(request: pytest.FixtureRequest) -> str:
    """Of ROS 2: each that `make test-ros2` names."""
    return request.param


@pytest.fixture(scope="session")
def built_bridge() -> Path:
    """The bridge; a failure where it is missing."""
    from bridge import load_script

    program = load_script().find_bridge()
    assert program is not None, "no zenoh-bridge-ros2dds: make ros2-bridge"
    return program


@pytest.fixture(scope="module")
def shared_ros_lab(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    built_bridge: Path,
    distribution: str,
) -> Iterator[RosLab]:
    """One lab with an rclpy robot for all tests of a file; take `ros_lab` instead."""
    from rclpy_rig import running_ros_lab

    folder = tmp_path_factory.mktemp("ros_lab")
    patience_s = getattr(request.module, "ROBOT_PATIENCE_S", CHAIN_PATIENCE_S)
    with running_ros_lab(folder, built_bridge, distribution, patience_s=patience_s) as lab:
        lab.chain.activate_when_ready()
        yield lab


@pytest.fixture
def ros_lab(shared_ros_lab: RosLab) -> RosLab:
    """The file's lab: inactive, the arm stands, nothing recorded, no event unread."""
    shared_ros_lab.settle()
    return shared_ros_lab
