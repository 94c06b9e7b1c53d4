"""A UR by the library ur_rtde, against a peer of our own that speaks RTDE (tests/ur_peer.py)."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver_report import Report

pytest.importorskip("rtde_control", reason="needs the extra ur")

from ur_peer import (
    IDLE,
    NORMAL,
    PROTECTIVE_STOP,
    ROBOT_EMERGENCY_STOP,
    RUNNING,
    SET_PAYLOAD,
    SET_TCP,
    SET_WATCHDOG,
    PeerProcess,
)
from vla_zenoh_ur.check import ur_arm

from vla_zenoh.errors import NodeError, ProfileError
from vla_zenoh.kinematics.so3 import log3
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types import JointReference

AT_HOME_RAD = np.array([0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])
NEAR_RAD = 1e-3
SOON_S = 4.0
UNHEARD_S = 0.5
"""Longer than the robot's watchdog of 5 Hz waits."""
PROFILE = """
extends: ur5e_rtde
ur: {{address: {address}, lookahead_s: 0.05, gain: 450, tcp_m: [0, 0, 0.1], payload_kg: 1.2,
     payload_centre_m: [0, 0, 0.04]}}
"""

pytestmark = [pytest.mark.slow, pytest.mark.realtime, pytest.mark.timeout(60)]


@pytest.fixture(scope="module")
def process() -> Iterator[PeerProcess]:
    with PeerProcess(ctx=multiprocessing.get_context("spawn")) as process:
        yield process


class Rig:
    """A driver, its robot, and what it reported."""

    def __init__(self, folder: Path, peer: Any) -> None:
        self.peer, path = peer, folder / "lab.yaml"
        path.write_text(PROFILE.format(address=peer.where()))
        self.profile: Profile = load_profile(str(path))
        self.driver = PythonDriver(self.profile)
        self.report = Report(self.driver)

    def read(self) -> Any:
        time.sleep(0.004)
        return self.driver.read(time.monotonic_ns())

    def measured(self) -> Any:
        while (measurement := self.read()) is None:
            pass  # the same state again: the robot's rate is another one
        return measurement

    def until(self, what: Callable[[], bool]) -> None:
        end_s = time.monotonic() + SOON_S
        while not what():
            assert time.monotonic() < end_s, (self.driver.fault, self.driver.gripper_mode)
            self.read()

    def lead(self, by_rad: float) -> None:
        """Lead joint 1 there within a quarter of a second."""
        begin = np.array(self.peer.look("q"))
        for step in range(1, 61):
            to_rad = begin + [by_rad * step / 60, 0, 0, 0, 0, 0]
            self.driver.move(JointReference(to_rad, np.zeros(6), np.zeros(6)), 0)
            self.read()

    @property
    def ready(self) -> bool:
        return not self.driver.fault and not self.driver.away

    def told(self, what: str) -> list[str]:
        return [event.why for event in self.report.events if event.what == what]


@pytest.fixture
def rig(tmp_path: Path, process: Any) -> Iterator[Rig]:
    peer = process.UrPeer()
    rig = Rig(tmp_path, peer)
    yield rig
    rig.driver.close()
    peer.close()


@pytest.fixture
def connected(rig: Rig) -> Rig:
    rig.driver.connect()
    rig.until(lambda: rig.ready)
    return rig


def test_tool_payload_and_watchdog_are_set_before_the_first_motion(connected: Rig) -> None:
    connected.read()
    done = dict(connected.peer.look("done"))
    assert done[SET_TCP] == (0, 0, 0.1, 0, 0, 0)
    assert done[SET_PAYLOAD] == (1.2, 0, 0, 0.04)
    assert done[SET_WATCHDOG] == (5.0,)
    assert connected.peer.look("servos") == []
    assert connected.peer.look("q") == AT_HOME_RAD.tolist()


def test_the_arm_follows_by_servoj_with_lookahead_and_gain_of_the_profile(connected: Rig) -> None:
    connected.lead(0.05)
    np.testing.assert_allclose(connected.peer.look("servos")[-1], (0.004, 0.05, 450))
    connected.until(lambda: abs(connected.peer.look("q")[0] - 0.05) < NEAR_RAD)
    state = connected.measured().joints
    np.testing.assert_allclose(state.position_rad, AT_HOME_RAD + [0.05, 0, 0, 0, 0, 0], atol=0.01)


def test_between_streams_the_robot_holds_its_set_point(connected: Rig) -> None:
    connected.lead(0.05)
    end_s = time.monotonic() + 2 * UNHEARD_S
    connected.until(lambda: time.monotonic() > end_s)
    assert connected.ready
    assert not connected.driver.idle
    assert abs(connected.peer.look("q")[0] - 0.05) < NEAR_RAD


def test_a_force_is_reported_in_the_base_of_the_description(connected: Rig) -> None:
    connected.peer.put(wrench=[1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    connected.until(lambda: connected.measured().pose.wrench[2] == 3.0)
    np.testing.assert_allclose(connected.measured().pose.wrench, [1, 2, 3, 0.1, 0.2, 0.3])


def test_a_protective_stop_is_a_fault_by_its_name_until_a_person_resets(connected: Rig) -> None:
    connected.lead(0.05)
    connected.peer.protective_stop()
    connected.until(lambda: connected.driver.fault != "")
    assert "PROTECTIVE_STOP" in connected.told("robot_fault")[0]
    held, servos = connected.peer.look("q"), len(connected.peer.look("servos"))
    connected.lead(0.05)
    assert connected.peer.look("q") == held
    assert len(connected.peer.look("servos")) == servos

    connected.driver.recover()
    connected.until(lambda: connected.ready)
    assert "unlock protective stop" in connected.peer.look("dashboard")
    assert connected.peer.look("q") == held
    connected.lead(0.02)
    connected.until(lambda: abs(connected.peer.look("q")[0] - held[0] - 0.02) < NEAR_RAD)


def test_a_protective_stop_ended_at_the_pendant_still_needs_a_reset(connected: Rig) -> None:
    connected.peer.protective_stop()
    connected.until(lambda: connected.driver.fault != "")
    connected.peer.put(safety_mode=NORMAL)
    connected.until(lambda: "reset" in connected.driver.fault)
    uploads = connected.peer.look("uploads")
    for _ in range(100):
        connected.read()
    assert not connected.ready
    assert connected.peer.look("uploads") == uploads


def test_a_reset_that_the_robot_rejects_is_told_in_its_words(connected: Rig) -> None:
    connected.peer.protective_stop()
    connected.peer.put(unlockable=False)
    connected.until(lambda: connected.driver.fault != "")
    connected.driver.recover()
    connected.until(lambda: "until 5s after" in connected.driver.fault)
    assert connected.peer.look("safety_mode") == PROTECTIVE_STOP


def test_an_emergency_stop_is_not_touched_by_a_reset(connected: Rig) -> None:
    connected.peer.stop(ROBOT_EMERGENCY_STOP)
    connected.until(lambda: "ROBOT_EMERGENCY_STOP" in connected.driver.fault)
    connected.driver.recover()
    for _ in range(50):
        connected.read()
    assert "ROBOT_EMERGENCY_STOP" in connected.driver.fault
    assert not connected.peer.look("program")


def test_a_slowed_robot_takes_no_commands_and_says_why(connected: Rig) -> None:
    connected.peer.put(slider=0.5)
    connected.until(lambda: connected.driver.gripper_mode == "speed slider at 50 %")
    assert connected.driver.away == "not_ready"
    assert connected.driver.status().detail["speed_slider"] == 0.5
    connected.peer.put(slider=1.0)
    connected.until(lambda: connected.ready)


def test_a_robot_that_is_not_running_is_not_ready_by_its_mode(rig: Rig) -> None:
    rig.peer.put(robot_mode=IDLE)
    rig.driver.connect()
    rig.until(lambda: rig.driver.gripper_mode == "robot mode IDLE")
    assert not rig.driver.fault
    rig.peer.put(robot_mode=RUNNING)
    rig.until(lambda: "reset" in rig.driver.fault)
    rig.driver.recover()
    rig.until(lambda: rig.ready)


def test_a_node_that_stands_still_makes_the_robots_own_watchdog_stop_it(connected: Rig) -> None:
    connected.lead(0.05)
    time.sleep(UNHEARD_S)
    assert not connected.peer.look("program")
    connected.until(lambda: "watchdog" in connected.driver.fault)


def test_a_lost_connection_stops_the_robot_and_ends_the_node(connected: Rig) -> None:
    connected.lead(0.05)
    connected.peer.cut()
    with pytest.raises(NodeError, match="connection lost"):
        connected.until(lambda: False)
    with pytest.raises(NodeError, match="connection lost"):
        connected.lead(0.05)
    assert not connected.peer.look("program")


def test_the_next_connection_moves_nothing(connected: Rig, tmp_path: Path) -> None:
    connected.lead(0.05)
    connected.peer.cut()
    with pytest.raises(NodeError, match="connection lost"):
        connected.until(lambda: False)
    held = connected.peer.look("q")
    connected.peer.put(target=None, servos=[])
    connected.peer.listen()
    again = Rig(tmp_path, connected.peer)
    again.driver.connect()
    again.until(lambda: again.ready)
    assert connected.peer.look("servos") == []
    assert connected.peer.look("q") == held
    again.driver.close()


def test_a_robot_without_remote_control_is_told_so(rig: Rig) -> None:
    rig.peer.put(remote=False)
    with pytest.raises(NodeError, match="enable remote control"):
        rig.driver.connect()


def test_a_robot_that_does_not_answer_is_told_with_what_to_look_at(rig: Rig) -> None:
    rig.peer.cut()
    with pytest.raises(NodeError, match=r"no answer on port 29999.*Is the robot on"):
        rig.driver.connect()
    rig.peer.listen()


@pytest.mark.parametrize(("off_m", "level"), [(0.002, "ok"), (0.1, "fail")])
def test_the_check_compares_the_robots_tcp_with_the_description(
    rig: Rig, off_m: float, level: str
) -> None:
    pose = rig.driver.kinematics.forward(AT_HOME_RAD)
    position_m = pose.position_m + [0, 0, off_m]
    rig.peer.put(tcp_pose=[*position_m.tolist(), *log3(pose.rotation).tolist()])
    found = {each.name: each for each in ur_arm(rig.profile, rig.profile.driver_options)}
    assert found["connection"].level == "ok"
    assert found["state"].found == "robot mode RUNNING, safety mode NORMAL"
    assert found["kinematics"].level == level
    assert rig.peer.look("uploads") == 0


def test_only_joints_can_be_commanded(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text("extends: ur5e_rtde\nrobot: {command: pose}\n")
    with pytest.raises(ProfileError, match="must be joint"):
        load_profile(str(path))
