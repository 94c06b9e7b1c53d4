"""physicalai 0.3.0 itself: its owner behind our driver, its client before our worker."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver_rig import DriverRig
from physicalai_rig import Client, Owner

from vla_zenoh.errors import NodeError, PeerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, JointReference, JointState

SOON_S, LOST_S = 10.0, 3.0
EXACT_RAD = 1e-6
STILL = np.zeros(5)
PROFILE = "extends: so101_physicalai\nphysicalai: {name: rival, units: normalised}\n"

pytestmark = pytest.mark.timeout(120)


class Rig(DriverRig):
    """Our driver of the robot ``rival``."""

    soon_s = SOON_S

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, PROFILE)

    def position_rad(self) -> np.ndarray:
        self.newest = None
        self.until(lambda: self.newest is not None)
        return self.newest.joints.position_rad

    def is_at(self, wanted_rad: np.ndarray) -> bool:
        return np.allclose(self.position_rad(), wanted_rad, atol=EXACT_RAD)


@pytest.fixture
def owner() -> Iterator[Owner]:
    with Owner("rival") as owner:
        yield owner


@pytest.fixture
def rig(owner: Owner, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.driver.connect()
    yield rig
    rig.driver.close()


def test_its_owner_follows_our_commands_and_its_states_say_so(rig: Rig) -> None:
    begin_rad = rig.position_rad()
    for step in range(1, 21):
        wanted_rad = begin_rad + step * 0.005
        rig.driver.move(JointReference(wanted_rad, STILL, STILL), 0)
        time.sleep(0.02)
    rig.until(lambda: rig.is_at(begin_rad + 0.1))
    assert rig.driver.fault == ""
    assert rig.driver.status().detail["class"] == "physicalai_peer_process.Arm"


def test_its_client_beside_us_is_a_second_commander(rig: Rig) -> None:
    begin_rad = rig.position_rad()
    rig.driver.move(JointReference(begin_rad, STILL, STILL), 0)
    with Client("rival") as client:
        client.attached()
        rig.until(lambda: rig.driver.away == "")
        began_s = time.monotonic()
        client.ask(act=[0.0] * 6)
        rig.until(lambda: rig.driver.fault != "")
        print(f"a second commander was told after {time.monotonic() - began_s:.3f} s")
    assert "somebody else puts actions" in rig.driver.fault


def test_its_owner_killed_ends_our_node(rig: Rig, owner: Owner) -> None:
    rig.position_rad()
    began_s = time.monotonic()
    owner.kill()
    with pytest.raises(NodeError, match="no valid state of 'rival' for 1 s"):
        rig.until(lambda: False)
    assert time.monotonic() - began_s < LOST_S


class Worker:
    """Our worker's model ``physicalai_client``, asked ten times a second about an arm at home."""

    def __init__(self) -> None:
        profile = load_profile("so101_sim")
        self.home_rad = np.array(profile.robot.home_rad)
        self.model: Any = make_policy(
            find_model("physicalai_client"), {"profile": "so101_sim", "name": "rival"}
        )
        joint = JointState(profile.robot.arm_joints, self.home_rad, STILL, STILL)
        self._seen = replace(
            example_observation(self.model.spec, prompt=""),
            joint=joint,
            gripper=GripperState(0.04, moving=False, holding=False),
        )
        self.answers: list[Any] = []
        self._stop = threading.Event()
        self.model.load()
        self.model.reset()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            seen = replace(self._seen, stamp_wall_ns=time.time_ns())
            try:
                self.answers.append(np.array(self.model.infer(seen).steps[0]))
            except PeerError as error:
                self.answers.append(str(error))

    def next_answer(self) -> Any:
        count, end_s = len(self.answers), time.monotonic() + SOON_S
        while len(self.answers) == count:
            assert time.monotonic() < end_s
            time.sleep(0.02)
        return self.answers[-1]

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.model.close()


@pytest.fixture
def worker() -> Iterator[Worker]:
    worker = Worker()
    yield worker
    worker.close()


def test_its_client_reads_our_arm_and_its_action_is_our_step(worker: Worker) -> None:
    with Client("rival") as client:
        names = client.attached()
        assert names == [*load_profile("so101_sim").robot.arm_joints, "gripper"]
        seen = client.ask()["positions"]
        assert seen[5] == pytest.approx(40.0)
        end_s = time.monotonic() + SOON_S
        while isinstance(step := worker.next_answer(), str):
            assert time.monotonic() < end_s
            client.ask(act=seen)
    np.testing.assert_allclose(step, [*worker.home_rad, 0.04], atol=EXACT_RAD)


def test_its_client_killed_leaves_our_worker_without_an_answer(worker: Worker) -> None:
    with Client("rival") as client:
        client.attached()
        end_s = time.monotonic() + SOON_S
        while isinstance(worker.next_answer(), str):
            assert time.monotonic() < end_s
            client.ask(act=[0.0] * 6)
        began_s = time.monotonic()
        client.kill()
        while not isinstance(worker.next_answer(), str):
            assert time.monotonic() - began_s < LOST_S
    assert "no client of 'rival' put a valid action" in worker.answers[-1]
