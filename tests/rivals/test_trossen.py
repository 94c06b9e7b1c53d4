"""Our driver moves trossen-arm-sim's WidowX AI by the maker's library; each side is killed."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver_rig import DriverRig
from physicalai_rig import Process
from trossen_rig import AT_HOME_RAD, HOME, Controller, TrossenProcess, bring_home

from vla_zenoh.types import GripperCommand, JointReference

DRIVER = Path(__file__).with_name("driver_process.py")
PROFILE = "extends: widowx_ai\ntrossen: {address: 127.0.0.1}\n"
APART_M, APART_RAD, APART_WIDTH_M = 1e-3, 3e-3, 1e-3
IN_MOTION_S = 1.2
STILL = np.zeros(6)
FAR_RAD = 0.6
OPEN_M, NARROW_M = 0.08, 0.03

pytestmark = pytest.mark.timeout(120)


class Lab:
    """A simulated arm at home, and our driver's process."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder = stack, folder
        self.controller = stack.enter_context(Controller())
        bring_home()

    def start(self) -> float:
        """Start the driver, and wait until the arm is in motion; the time."""
        profile = self._folder / "lab.yaml"
        profile.write_text(PROFILE)
        self.driver = Process(str(profile), python=sys.executable, script=DRIVER)
        self._stack.callback(self.driver.kill)
        self.told("ready")
        self.told("moving")
        time.sleep(IN_MOTION_S)
        return time.monotonic()

    def told(self, event: str) -> dict[str, Any]:
        """The driver's next line, which is `event`."""
        told = json.loads(self.driver.line())
        assert told["event"] == event, told
        return told


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(stack, tmp_path)


class Rig(DriverRig):
    """Our driver in this process."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, PROFILE)

    def go(self, target_rad: np.ndarray) -> None:
        """One set-point."""
        self.driver.move(JointReference(target_rad, STILL, STILL), 0)

    def grip(self, width_m: float) -> None:
        """Ask for an opening, and wait until the fingers stand there."""
        self.driver.grip(GripperCommand(width_m, 0.08, 10.0), 0)
        self.until(lambda: abs(self.newest.gripper.width_m - width_m) < APART_WIDTH_M)
        self.until(lambda: not self.newest.gripper.moving)


@pytest.fixture
def rig(lab: Lab, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.ready()
    yield rig
    rig.driver.close()


# -- states and motion ----------------------------------------------------------------------------
def test_the_arm_rests_where_its_command_ended(lab: Lab) -> None:
    lab.start()
    there = lab.told("there")
    print(there)
    assert there["apart_m"] < APART_M
    assert there["apart_rad"] < APART_RAD
    assert there["detail"]["not_sent"] == 0


def test_our_states_are_where_the_simulated_arm_is(rig: Rig, lab: Lab) -> None:
    rig.tick()
    at = lab.controller.joints_rad()
    np.testing.assert_allclose(rig.newest.joints.position_rad, at[:6], atol=APART_RAD)
    np.testing.assert_allclose(at[:6], HOME[:6], atol=AT_HOME_RAD)
    assert rig.newest.gripper.width_m == pytest.approx(2 * at[6], abs=APART_WIDTH_M)


def test_an_opening_is_that_between_both_fingers(rig: Rig, lab: Lab) -> None:
    for width_m in (OPEN_M, NARROW_M):
        rig.grip(width_m)
        assert lab.controller.joints_rad()[6] == pytest.approx(width_m / 2, abs=APART_WIDTH_M)
        assert not rig.newest.gripper.holding


def test_brakes_are_open_while_our_node_runs_and_closed_afterwards(
    lab: Lab, tmp_path: Path
) -> None:
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.ready()
    assert set(lab.controller.ask()["modes"]) == {"POSITION"}
    rig.driver.close()
    assert set(lab.controller.ask()["modes"]) == {"IDLE"}


# -- limits and faults ----------------------------------------------------------------------------
def test_a_jump_is_not_sent_and_a_reset_goes_on(rig: Rig, lab: Lab) -> None:
    begin_rad = np.array(rig.newest.joints.position_rad)
    rig.go(begin_rad + FAR_RAD * np.eye(6)[0])
    rig.until(lambda: "not sent" in rig.driver.fault)
    np.testing.assert_allclose(lab.controller.joints_rad()[:6], begin_rad, atol=APART_RAD)
    rig.driver.recover()
    rig.ready()
    rig.go(begin_rad + 0.002)
    rig.until(lambda: rig.newest.joints.position_rad[0] > begin_rad[0] + 0.001)


def test_an_error_of_the_controller_is_a_fault_in_its_words_until_a_reset(
    rig: Rig, lab: Lab
) -> None:
    began_s = time.monotonic()
    lab.controller.ask(fault="JOINT_LIMIT_EXCEEDED")
    rig.until(lambda: rig.driver.fault != "")
    print(f"an error was told after {time.monotonic() - began_s:.3f} s: {rig.driver.fault}")
    assert "Joint limit exceeded" in rig.driver.fault
    assert set(lab.controller.ask()["modes"]) == {"IDLE"}
    rig.driver.recover()
    rig.ready()
    assert set(lab.controller.ask()["modes"]) == {"POSITION"}


# -- each side killed, frozen, silent -------------------------------------------------------------
def test_our_driver_killed_leaves_the_arm_at_its_last_target(lab: Lab) -> None:
    since_s = lab.start()
    lab.driver.kill()
    print(f"arm stood after {lab.controller.stood(since_s)} (s, rad)")


def test_our_driver_frozen_leaves_the_arm_at_its_last_target(lab: Lab) -> None:
    since_s = lab.start()
    os.kill(lab.driver.pid, signal.SIGSTOP)
    print(f"arm stood after {lab.controller.stood(since_s)} (s, rad)")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_controller_that_falls_silent_ends_our_node(lab: Lab, how: signal.Signals) -> None:
    since_s = lab.start()
    os.kill(lab.controller.pid, how)
    lost = lab.told("lost")
    print(f"{how.name}: lost after {lost['at_s'] - since_s:.2f} s: {lost['why']}")
    lab.controller.kill()


# -- a second commander ---------------------------------------------------------------------------
def test_the_makers_client_gets_no_connection_while_we_have_it(lab: Lab) -> None:
    lab.start()
    with TrossenProcess("client") as client:
        assert "Failed to read" in client.begins["refused"]
    there = lab.told("there")
    assert there["apart_rad"] < APART_RAD


def test_targets_of_a_stranger_are_a_fault_and_the_arm_yields(rig: Rig, lab: Lab) -> None:
    begin_rad = lab.controller.joints_rad()[0]
    began_s = time.monotonic()
    with TrossenProcess("stranger", "0", str(begin_rad + FAR_RAD)):
        rig.until(lambda: "another program commands the arm" in rig.driver.fault)
        print(f"a stranger was told after {time.monotonic() - began_s:.2f} s: {rig.driver.fault}")
