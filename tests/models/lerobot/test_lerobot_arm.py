"""LeRobot's SO-101 behind our driver; its bus of motors is a mock, as in LeRobot's own tests."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import pytest
from driver_report import Report

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
from lerobot.robots.so_follower import so_follower

from vla_zenoh.errors import NodeError
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types import GripperCommand, JointReference

pytestmark = pytest.mark.models

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
MOTORS = (*JOINTS, "gripper")
DEGREES = dict(zip(MOTORS, (10.0, -20.0, 30.0, 40.0, -50.0, 60.0), strict=True))
COMMAND = GripperCommand(width_m=0.05, speed_m_s=0.1, force_n=10.0)


class Motors:
    """What the mocked bus remembers."""

    def __init__(self) -> None:
        self.present, self.goals = dict(DEGREES), []
        self.answers, self.calibrated = True, True
        self.released: list[bool] = []

    def bus(self, **given: Any) -> MagicMock:
        bus = MagicMock(name="FeetechMotorsBus")
        bus.motors, bus.calibration, bus.is_connected = given["motors"], given["calibration"], False
        type(bus).is_calibrated = property(lambda _: self.calibrated)

        def connect() -> None:
            bus.is_connected = True

        def disconnect(disable_torque: bool = True) -> None:
            bus.is_connected = False
            self.released.append(disable_torque)

        def sync_read(register: str, **_: Any) -> dict[str, float]:
            if not self.answers:
                raise ConnectionError("no status packet")
            return dict(self.present)

        def sync_write(register: str, goals: dict[str, float]) -> None:
            assert register == "Goal_Position"
            self.goals.append(goals)

        bus.connect.side_effect, bus.disconnect.side_effect = connect, disconnect
        bus.sync_read.side_effect, bus.sync_write.side_effect = sync_read, sync_write
        return bus


@pytest.fixture
def motors() -> Iterator[Motors]:
    motors = Motors()
    with patch.object(so_follower, "FeetechMotorsBus", side_effect=motors.bus):
        yield motors


def make_driver(folder: Path, more: str = "", *, calibrated: bool = True) -> PythonDriver:
    if calibrated:
        one = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
        (folder / "follower.json").write_text(json.dumps(dict.fromkeys(MOTORS, one)))
    path = folder / "lab.yaml"
    path.write_text(
        f"extends: so101_lerobot\nlerobot: {{calibration_dir: {folder}{more and ', ' + more}}}\n"
    )
    driver = PythonDriver(load_profile(str(path)))
    Report(driver)
    return driver


def connected(folder: Path, more: str = "") -> PythonDriver:
    driver = make_driver(folder, more)
    driver.connect()
    return driver


def read(driver: PythonDriver) -> Any:
    return driver.read(time.monotonic_ns())


def test_degrees_become_the_joints_of_the_description(motors: Motors, tmp_path: Path) -> None:
    joints = read(connected(tmp_path)).joints
    assert joints.names == JOINTS
    np.testing.assert_allclose(np.degrees(joints.position_rad), (10, -20, 30, 40, -50))


def test_a_set_point_is_written_to_the_motors_in_degrees(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path)
    rad = np.radians([1.0, 2.0, 3.0, 4.0, 5.0])
    driver.move(JointReference(rad, rad, rad), 0)
    (goals,) = motors.goals
    assert goals == pytest.approx(dict(zip(JOINTS, (1, 2, 3, 4, 5), strict=True)))


def test_zero_and_sign_of_a_joint_are_those_of_the_profile(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path, "zero_deg: [0, -90, 0, 0, 0], reversed: [elbow_flex]")
    found_rad = read(driver).joints.position_rad
    np.testing.assert_allclose(np.degrees(found_rad), (10, 70, -30, 40, -50))
    driver.move(JointReference(found_rad, found_rad, found_rad), 0)
    assert motors.goals[0] == pytest.approx({name: DEGREES[name] for name in JOINTS})


def test_normalised_joints_run_from_one_end_to_the_other(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path, "units: normalised")
    lower, upper = driver.joint_range_rad
    motors.present |= dict(zip(JOINTS, (-100, 100, 0, 50, -50), strict=True))
    share = np.array([0, 1, 0.5, 0.75, 0.25])
    found_rad = read(driver).joints.position_rad
    np.testing.assert_allclose(found_rad, lower + share * (upper - lower))
    driver.move(JointReference(found_rad, found_rad, found_rad), 0)
    assert motors.goals[0] == pytest.approx(dict(zip(JOINTS, (-100, 100, 0, 50, -50), strict=True)))


def test_connecting_commands_nothing(motors: Motors, tmp_path: Path) -> None:
    read(connected(tmp_path))
    assert motors.goals == []


def test_the_gripper_has_its_width(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path)
    assert read(driver).gripper.width_m == pytest.approx(0.06)
    driver.grip(COMMAND, 0)
    assert motors.goals == [{"gripper": pytest.approx(50.0)}]


def test_a_gripper_that_is_kept_open_holds_something(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path)
    report = Report(driver)
    driver.grip(COMMAND, 0)
    assert read(driver).gripper.moving
    time.sleep(0.4)
    assert read(driver).gripper.holding
    motors.present["gripper"] = 50.0
    read(driver)
    time.sleep(0.4)
    assert not read(driver).gripper.holding
    assert [event.what for event in report.events] == ["grasped", "object_lost"]


def test_an_arm_without_gripper_rejects_its_commands(motors: Motors, tmp_path: Path) -> None:
    assert "no method grip" in connected(tmp_path, 'gripper: ""').no_gripper


def test_a_packet_that_is_lost_is_no_measurement(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path)
    assert read(driver) is not None
    motors.answers = False
    assert read(driver) is None
    motors.answers = True
    assert read(driver) is not None
    assert driver.status().detail["failed_reads"] == 1


def test_motors_that_fell_silent_end_the_node(motors: Motors, tmp_path: Path) -> None:
    driver = connected(tmp_path)
    read(driver)
    motors.answers = False
    time.sleep(1.1)
    with pytest.raises(NodeError, match="no status packet"):
        read(driver)


def test_an_arm_without_calibration_is_told_how_to_make_one(motors: Motors, tmp_path: Path) -> None:
    with pytest.raises(NodeError, match=r"no calibration .*lerobot-calibrate --robot\.type=so101"):
        make_driver(tmp_path, calibrated=False).connect()


def test_motors_of_another_calibration_are_rejected(motors: Motors, tmp_path: Path) -> None:
    motors.calibrated = False
    with pytest.raises(NodeError, match="another calibration than follower"):
        make_driver(tmp_path).connect()


@pytest.mark.parametrize("more", ["", "limp_at_end: true"])
def test_the_arm_is_held_at_the_end_unless_the_profile_lets_it_go(
    motors: Motors, tmp_path: Path, more: str
) -> None:
    connected(tmp_path, more).close()
    assert motors.released == [bool(more)]


def test_a_robot_that_lerobot_does_not_have_is_named(motors: Motors, tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="LeRobot's so999"):
        make_driver(tmp_path, "robot: so999").connect()
