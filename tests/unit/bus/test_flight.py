"""The flight recorder of the fault tests writes down what the nodes of today publish."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.node import Publisher, publish_together
from vla_zenoh.guard.stream_guard import CommandStream
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.command.inputs import CommandInputs
from vla_zenoh.types import JointCommand, JointState, PoseCommand, PoseState

FILE = Path(__file__).parents[3] / "reliability/netns/flight/sitecustomize.py"
UNTURNED = np.array([0.0, 0.0, 0.0, 1.0])
PLACE_M, ZERO = np.array([0.4, 0.1, 0.3]), np.zeros(6)
JOINTS_RAD = np.arange(3.0)


class Session:
    """In place of Zenoh's: nothing is sent."""

    def declare_publisher(self, *_: Any, **__: Any) -> Session:
        return self

    def put(self, *_: Any, **__: Any) -> None:
        pass


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("flight_recorder", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for owner, name in ((Publisher, "publish"), (CommandStream, "take"), (CommandInputs, "poll")):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # and put back at the end
    return module


def publisher(key: str) -> Publisher:
    session: Any = Session()
    return Publisher(session, f"vla/pair/{key}", Kind.STATE, "node#1", Clock())


def pose_state() -> PoseState:
    return PoseState(PLACE_M, UNTURNED, ZERO, None, PLACE_M, UNTURNED)


def joint_state() -> JointState:
    return JointState(("a", "b", "c"), JOINTS_RAD, np.zeros(3), np.zeros(3))


def test_a_pose_that_is_published_with_others_is_kept(flight: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "sim.flight"
    flight._install("sim", str(file))
    both = (publisher("state/pose"), pose_state()), (publisher("state/joint"), joint_state())
    publish_together(1_700_000_000_000_000_000, 7, *both)
    row = np.fromfile(file)
    np.testing.assert_allclose(row[1:4], PLACE_M)


def test_a_commanded_pose_is_kept(flight: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "command.flight"
    flight._install("command", str(file))
    command = PoseCommand(PLACE_M, UNTURNED, ZERO, ZERO, PLACE_M, UNTURNED, "active", None)
    publisher("command/pose").publish(command)
    np.testing.assert_allclose(np.fromfile(file)[1:4], PLACE_M)


@pytest.mark.parametrize("node", ["sim", "command"])
def test_the_joints_of_a_part_are_kept_and_a_blocked_key_is_not_sent(
    node: str, flight: ModuleType, tmp_path: Path
) -> None:
    flight._install_parts(node, tmp_path, ["left"])
    record: JointState | JointCommand = joint_state()
    if node == "command":
        record = JointCommand(("a", "b", "c"), JOINTS_RAD, np.zeros(3), np.zeros(3), "active", None)
    key = "left/state/joint" if node == "sim" else "left/command/joint"
    publisher(key).publish(record)
    (tmp_path / "blocked").write_text("1.0 left")
    publisher(key).publish(record)
    rows = np.fromfile(tmp_path / f"left.{node}.joints").reshape(2, -1)
    np.testing.assert_allclose(rows[:, 1:4], [JOINTS_RAD, JOINTS_RAD])
