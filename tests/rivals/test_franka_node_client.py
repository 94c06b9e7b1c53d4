"""franka-node-client 0.4.0 itself beside our driver, at a node of our own that speaks its wire."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver_rig import DriverRig
from franka_node_peer import ENDPOINT, FrankaNode
from franka_node_rig import SCRIPT, Client, python
from vla_zenoh_franka_node import wire

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import load_profile

SOON_S = 20.0
PROFILE = f"""
extends: fr3_franka_node
robot: {{command: joint}}
franka_node: {{endpoint: "{ENDPOINT}"}}
"""

pytestmark = pytest.mark.timeout(120)


class Rig(DriverRig):
    """Our driver at the node."""

    soon_s = SOON_S

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, PROFILE)

    def ask(self, client: Client, verb: str) -> dict[str, Any]:
        """What their client says to a verb, while ours goes on."""
        client.send(verb=verb)
        while not client.answered():
            self.tick()
        return client.answer()


@pytest.fixture
def node() -> Iterator[FrankaNode]:
    profile = load_profile("fr3_franka_node")
    home_rad = np.array(profile.robot.home_rad)
    kinematics = make_kinematics(profile)
    tcp = kinematics.forward(kinematics.ordered(profile.robot.arm_joints, home_rad))
    ee = np.eye(4)
    ee[:3, :3], ee[:3, 3] = tcp.rotation, tcp.position_m
    with FrankaNode(home_rad, ee) as node:
        yield node


@pytest.fixture
def rig(node: FrankaNode, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.driver.connect()
    yield rig
    rig.driver.close()


@pytest.fixture
def client(node: FrankaNode) -> Iterator[Client]:
    with Client(ENDPOINT, "fr3") as client:
        yield client


def test_our_bytes_are_those_of_its_client() -> None:
    for kind in ("cartesian", "joints"):
        told = subprocess.run(
            [python(), str(SCRIPT), "encode", kind], capture_output=True, text=True, check=True
        ).stdout.splitlines()
        values = np.array([0.1 * number for number in range(1, 8)])
        assert wire.encode_target(kind, 7, 3, 5, values).hex() == told[0]
        assert wire.encode_gripper(wire.GRASP, 7, 3, 5, 0.02, 25.0).hex() == told[1]
        ours = json.loads(wire.encode_request(7, mode=kind, episode="a-1"))
        assert ours == json.loads(told[2])


def test_its_client_drives_the_node_that_our_driver_is_tested_with(
    node: FrankaNode, client: Client
) -> None:
    before_m = node.ee[2, 3]
    assert client.ask(verb="acquire")["said"] == "ok"
    assert client.ask(verb="drive")["said"] == "ok"
    assert node.ee[2, 3] == pytest.approx(before_m + 0.01, abs=1e-6)
    enabled = [request for verb, request in node.asked if verb == "enable"]
    assert enabled[0]["episode"] == "theirs"


def test_our_lease_holds_against_its_client(rig: Rig, client: Client) -> None:
    rig.ready()
    ours = rig.driver.status().detail["client_id"]
    told = rig.ask(client, "acquire")
    assert told["said"] == f"held by {ours}"
    assert told["holder"] == ours
    assert told["phase"] == "active"
    told = rig.ask(client, "drive")
    assert "not the holder" in told["said"]
    assert rig.driver.fault == ""
    assert rig.driver.away == ""


def test_the_lease_of_its_client_holds_against_us(
    node: FrankaNode, client: Client, tmp_path: Path
) -> None:
    told = client.ask(verb="acquire")
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.until(lambda: rig.newest is not None)
    assert f"client {told['id']} of franka-node has the lease" in rig.driver.gripper_mode
    assert rig.driver.away == "not_ready"
    client.kill()
    rig.ready()
    rig.driver.close()


def test_its_client_may_stop_our_arm_and_a_reset_goes_on(rig: Rig, client: Client) -> None:
    rig.ready()
    began_s = time.monotonic()
    client.send(verb="stop")
    rig.until(lambda: rig.driver.fault != "")
    print(f"its stop was told after {time.monotonic() - began_s:.3f} s")
    assert "somebody asked it to stop" in rig.driver.fault
    rig.driver.recover()
    rig.ready()


def test_an_arm_that_we_gave_back_is_its_clients(
    node: FrankaNode, client: Client, rig: Rig
) -> None:
    rig.ready()
    rig.driver.close()
    assert client.ask(verb="acquire")["said"] == "ok"
