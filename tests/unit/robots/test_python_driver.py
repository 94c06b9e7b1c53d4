"""A robot in a Python file, driven without a bus."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from driver_report import Report

from vla_zenoh.codec import records
from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import exp3
from vla_zenoh.profile import load_profile
from vla_zenoh.robot import Reading
from vla_zenoh.robots.python_driver import FAULT_NS, PythonDriver
from vla_zenoh.types import Event, GripperCommand, JointCommand, JointReference, NodeStatus
from vla_zenoh.types.records import PoseReference

ARM = """
from vla_zenoh.robot import Reading


class MyArm:
    def __init__(self):
        self.calls, self.said = [], {}

    def read(self):
        if "raises" in self.said:
            raise OSError("the cable is out")
        return Reading(**{"position_rad": [0, -0.0439, 0, -2.627, 0, 2.583, 0.785], **self.said})

    def move(self, command):
        self.calls.append(command)
"""
MORE = """
    def connect(self):
        self.calls.append("connect")

    def grip(self, width_m, speed_m_s, force_n):
        self.calls.append((width_m, speed_m_s, force_n))

    def recover(self):
        self.calls.append("recover")

    def status(self):
        return {"temperature_c": 40}

    def close(self):
        self.calls.append("close")
"""
PROFILE = """
extends: panda_sim
robot: {driver: arm, command: joint}
arm: {file: my_arm.py}
cameras: {front: null, wrist: null}
hosts: {here: {nodes: [router, arm, command, worker]}}
"""
MS_NS = 1_000_000


class WatchedReading(Reading):
    """A reading that knows which of its fields were asked for."""

    __slots__ = ()
    asked: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> Any:
        WatchedReading.asked.add(name)
        return super().__getattribute__(name)


class Rig:
    """A driver, its arm, and what it reported."""

    def __init__(self, folder: Path, arm: str) -> None:
        (folder / "my_arm.py").write_text(arm)
        (folder / "lab.yaml").write_text(PROFILE)
        self.driver = PythonDriver(load_profile(str(folder / "lab.yaml")))
        self.report = Report(self.driver)
        self.now_ns = 10**12

    @property
    def calls(self) -> list[Any]:
        return self.driver.robot.calls

    def read(self, **said: Any) -> Any:
        self.now_ns += FAULT_NS
        self.driver.robot.said = said
        return self.driver.read(self.now_ns)

    def told(self, what: str) -> list[Event]:
        return [event for event in self.report.events if event.what == what]


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path, ARM + MORE)


@pytest.fixture
def plain(tmp_path: Path) -> Rig:
    return Rig(tmp_path, ARM)


def test_a_reading_becomes_a_measurement(rig: Rig) -> None:
    measurement = rig.read(width_m=0.03, wrench=[1, 2, 3, 0, 0, 0])
    assert measurement.joints.names == rig.driver.profile.robot.arm_joints
    np.testing.assert_allclose(measurement.pose.wrench[:3], [1, 2, 3])
    assert measurement.gripper.width_m == 0.03


def test_no_field_of_a_reading_is_left_unread(rig: Rig) -> None:
    home_rad = rig.driver.profile.robot.home_rad
    rig.driver.robot.read = lambda: WatchedReading(home_rad)
    WatchedReading.asked.clear()
    assert rig.driver.read(rig.now_ns) is not None
    assert {field.name for field in fields(Reading)} <= WatchedReading.asked


def test_a_set_point_reaches_the_arm_as_a_command(rig: Rig) -> None:
    rad = np.full(7, 0.1)
    rig.driver.move(JointReference(rad, rad / 2, rad / 4), 0)
    (command,) = rig.calls
    assert isinstance(command, JointCommand)
    np.testing.assert_array_equal(command.velocity_rad_s, rad / 2)
    assert rig.report.counters["arm.commands_given"] == 1


def test_the_quaternions_of_a_tool_that_points_down_keep_their_sign(rig: Rig) -> None:
    """Its w is about zero; a robot that interpolates from one to the next must not go around."""
    down = np.diag([1.0, -1.0, -1.0])
    for turn in ([0, 0, 0], [1e-3, 0, 0.5], [-1e-3, 0, 1.0], [1e-3, 0, 1.5], [-1e-9, 0, 2.0]):
        rotation = exp3(np.array(turn)) @ down
        rig.driver.move(PoseReference(np.zeros(3), rotation, np.zeros(6), np.zeros(6)), 0)
    quats = np.array([command.quat_xyzw for command in rig.calls])
    assert ((quats[1:] * quats[:-1]).sum(axis=1) > 0.9).all()


def test_an_invalid_reading_is_rejected_and_its_fault_counts(rig: Rig) -> None:
    assert rig.read(position_rad=[float("nan")] * 7, fault="the user stop is pressed") is None
    assert rig.driver.fault == "the user stop is pressed"
    assert rig.driver.away == "fault"
    assert rig.report.counters["refused.invalid"] == 1
    assert rig.told("robot_fault")[0].why == "the user stop is pressed"
    rig.read()
    assert (rig.driver.fault, rig.driver.away) == ("", "")


def test_the_status_has_the_reason_of_a_rejected_reading_until_one_is_taken(rig: Rig) -> None:
    rig.read(position_rad=[0.0] * 5)
    why = "my_arm.py: read: position_rad has shape (5,), wanted (7,)"
    assert rig.driver.status().detail["complaint"] == why
    rig.read(position_rad=[0.0] * 5, fault="the user stop is pressed")
    assert "complaint" not in rig.driver.status().detail  # the fault matters more
    rig.read()
    assert "complaint" not in rig.driver.status().detail


def test_the_same_measurement_twice_is_one(rig: Rig) -> None:
    assert rig.read(measured_ns=5) is not None
    assert rig.read(measured_ns=5) is None


def test_what_the_class_raises_names_file_and_method(rig: Rig) -> None:
    with pytest.raises(NodeError, match=r"my_arm.py: read: .*the cable is out"):
        rig.read(raises=True)


def test_a_class_that_wants_the_other_kind_of_command_is_told_which_the_profile_has(
    tmp_path: Path,
) -> None:
    poses = ARM.replace("self.calls.append(command)", "self.calls.append(command.position_m)")
    rig, there = Rig(tmp_path, poses), JointReference.at_rest(np.zeros(7))
    wanted = r"my_arm.py: move: .*'JointCommand'.* no attribute.*; robot.command is joint"
    with pytest.raises(NodeError, match=wanted):
        rig.driver.move(there, rig.now_ns)


def test_a_robot_in_another_mode_takes_no_commands_and_says_so(rig: Rig) -> None:
    rig.read()
    rig.read(mode="Guiding")
    assert (rig.driver.gripper_mode, rig.driver.away) == ("Guiding", "not_ready")
    rig.read()
    assert (rig.driver.gripper_mode, rig.driver.away) == ("ready", "")
    assert len(rig.told("robot:ready->Guiding")) == len(rig.told("robot:Guiding->ready")) == 1


def test_a_grasp_and_the_loss_of_the_object_are_told_once(rig: Rig) -> None:
    for _ in range(3):
        rig.read(width_m=0.04, holding=True)
    assert len(rig.told("grasped")) == 1
    for _ in range(3):
        rig.read(width_m=0.0, holding=False)
    assert len(rig.told("object_lost")) == 1


def test_an_object_that_is_lost_while_the_fingers_close_again_is_told(rig: Rig) -> None:
    rig.read(width_m=0.04, holding=True)
    rig.read(width_m=0.02, holding=False, moving=True)
    rig.read(width_m=0.0, holding=False)
    assert len(rig.told("object_lost")) == 1


@pytest.mark.parametrize("width_m", [1.0, 0.5, 0.11, -0.03, 80.0])
def test_a_width_that_the_gripper_cannot_have_is_rejected_whole(rig: Rig, width_m: float) -> None:
    assert rig.read(width_m=width_m) is None
    assert "width_m" in rig.driver.status().detail["complaint"]
    assert rig.read(width_m=0.081) is not None


def test_closing_again_on_the_same_object_is_no_second_grasp(rig: Rig) -> None:
    rig.read(width_m=0.04, holding=True)
    rig.read(width_m=0.04, holding=False, moving=True)
    rig.read(width_m=0.039, holding=True)
    assert len(rig.told("grasped")) == 1
    assert not rig.told("object_lost")


def test_letting_go_is_no_loss(rig: Rig) -> None:
    rig.read(width_m=0.04, holding=True)
    rig.read(width_m=0.05, holding=False, moving=True)
    rig.read(width_m=0.08, holding=False)
    assert not rig.told("object_lost")


def test_optional_methods_are_called(rig: Rig) -> None:
    driver = rig.driver
    assert driver.recovers
    assert not driver.no_gripper
    driver.connect()
    driver.grip(GripperCommand(0.02, 0.1, 5.0), 0)
    driver.recover()
    driver.close()
    assert rig.calls == ["connect", (0.02, 0.1, 5.0), "recover", "close"]
    assert driver.status().detail["temperature_c"] == 40
    assert driver.status().detail["width_m"] == 0.02  # none was measured: that of the command


@pytest.mark.parametrize(
    "told", [math.nan, math.inf, b"1.2", 10**30, {1: 2}, [[[[1]]]], "x" * 10**6]
)
def test_whatever_it_tells_of_itself_is_published(told: Any, rig: Rig) -> None:
    for found in ({"told": told}, [told]):
        rig.driver.robot.status = lambda found=found: found
        detail = rig.driver.status().detail
        assert {"told", "value"} & set(detail)
        records.encode(NodeStatus("arm", "running", "here", 1, 2, detail=detail))


def test_they_may_be_missing(plain: Rig) -> None:
    driver = plain.driver
    driver.connect()
    driver.recover()
    driver.close()
    assert not driver.recovers
    assert driver.no_gripper == "my_arm.py has no method grip"
