"""The simulated robot, driven without a bus."""

from __future__ import annotations

import numpy as np
import pytest
from driver_report import Report

from vla_zenoh.profile import load_profile
from vla_zenoh.robots.sim_driver import SimDriver
from vla_zenoh.simulation.world import STEP_NS
from vla_zenoh.types import GripperCommand, JointReference, PoseReference

SETTLED_M, SETTLED_RAD, SHUT_M = 2e-3, 5e-3, 0.01
STILL = np.zeros(6)


@pytest.fixture(scope="module")
def driver() -> SimDriver:
    driver = SimDriver(load_profile("panda_sim"))
    Report(driver)
    return driver


def run(driver: SimDriver, reference: PoseReference | JointReference, steps: int = 1500) -> None:
    arm = driver.parts[""]
    for step in range(1, steps + 1):
        driver.poll(step * STEP_NS)
        arm.move(reference, step * STEP_NS)
        arm.read(step * STEP_NS)


def test_it_goes_to_a_pose(driver: SimDriver) -> None:
    driver.reset(None)
    here = driver.parts[""].state_now().pose
    wanted_m = here.position_m + [0.0, 0.0, 0.02]
    run(driver, PoseReference(wanted_m, here.rotation, STILL, STILL))
    np.testing.assert_allclose(
        driver.parts[""].state_now().pose.position_m, wanted_m, atol=SETTLED_M
    )


def test_it_goes_to_joint_positions(driver: SimDriver) -> None:
    driver.reset(None)
    wanted_rad = driver.parts[""].state_now().position_rad + 0.05
    zeros = np.zeros(len(wanted_rad))
    run(driver, JointReference(wanted_rad, zeros, zeros))
    np.testing.assert_allclose(
        driver.parts[""].state_now().position_rad, wanted_rad, atol=SETTLED_RAD
    )


def test_measurements_come_at_the_state_rate(driver: SimDriver) -> None:
    driver.reset(None)
    found = [driver.parts[""].read(step * STEP_NS) for step in range(1, 1001)]
    count = sum(measurement is not None for measurement in found)
    assert count == pytest.approx(driver.profile.timing.state_hz, rel=0.01)


def test_the_gripper_closes(driver: SimDriver) -> None:
    driver.reset(None)
    driver.parts[""].grip(GripperCommand(0.0, 0.1, 20.0), 0)
    here = driver.parts[""].state_now().pose
    run(driver, PoseReference(here.position_m, here.rotation, STILL, STILL))
    assert driver.world.gripper_state().width_m < SHUT_M


def test_a_reset_puts_the_arm_home_and_is_counted(driver: SimDriver) -> None:
    report = Report(driver)
    driver.reset(None)
    before = report.counters["sim.resets"]
    driver.status_changed()
    driver.reset(5)
    home_rad = driver.profile.robot.home_rad
    np.testing.assert_allclose(driver.parts[""].state_now().position_rad, home_rad, atol=1e-9)
    assert report.counters["sim.resets"] == before + 1
    assert driver.status_changed()
    assert not driver.status_changed()
