"""Joints that turn without an end, as robots report them: wrapped anywhere, or counted."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from driver_report import Report
from endless_arm import ENDLESS, HOME_RAD, endless_arm
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.errors import CodecError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import load_profile, override
from vla_zenoh.robots.joint_reading import JointReading
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types import FloatArray, JointReference, JointState
from vla_zenoh.types.records import Joints

TURN = 2 * math.pi
PROFILE = endless_arm(Path(tempfile.mkdtemp()))
KINEMATICS = make_kinematics(PROFILE)
NAMES = KINEMATICS.arm_joints
TURNS = KINEMATICS.endless
STAMP_NS = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000

REPORTED: dict[str, Callable[[FloatArray], FloatArray]] = {
    "from -pi to pi": lambda at: np.mod(at + math.pi, TURN) - math.pi,
    "from 0 to 2 pi": lambda at: np.mod(at, TURN),
    "counted": lambda at: at,
    "counted from elsewhere": lambda at: at - 12 * TURN,
}
STEPS = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=40)


class Robot:
    """What a robot reports of the truth, and what is made of it."""

    def __init__(self, says: Callable[[FloatArray], FloatArray]) -> None:
        self._says, self.reading = says, JointReading(PROFILE, KINEMATICS)
        self._stamp_ns = STAMP_NS

    def said(self, true_rad: FloatArray) -> FloatArray:
        return np.where(TURNS, self._says(true_rad), true_rad)

    def reports(self, position_rad: FloatArray, velocity: FloatArray | None = None) -> JointState:
        self._stamp_ns += PERIOD_NS
        joints = Joints(self._stamp_ns, NAMES, position_rad, velocity, None)
        taken = self.reading.take(joints, self._stamp_ns)
        assert taken is not None
        return taken


@pytest.mark.parametrize("form", REPORTED)
@given(STEPS, st.floats(-50.0, 50.0))
def test_it_is_counted_over_turns_however_it_is_reported(
    form: str, steps: list[float], start: float
) -> None:
    robot, true_rad = Robot(REPORTED[form]), np.array(HOME_RAD) + start * TURNS
    first = robot.reports(robot.said(true_rad)).position_rad
    assert (first[TURNS] > -math.pi).all()
    assert (first[TURNS] <= math.pi).all()
    counted = first
    for step in steps:
        true_rad = true_rad + step * TURNS
        counted = robot.reports(robot.said(true_rad)).position_rad
        # What the robot is sent is near to what it reports, so that it never turns back.
        back = counted - robot.reading.turned_rad
        assert back == pytest.approx(robot.said(true_rad), abs=1e-9)
    assert (counted - first)[TURNS] == pytest.approx(sum(steps), abs=1e-6)
    assert counted[~TURNS] == pytest.approx(true_rad[~TURNS])


def test_a_range_of_the_profile_is_read_as_one_however_it_is_wrapped() -> None:
    ranges = [None, None, None, None, None, [0.5, 6.0]]
    ended = override(PROFILE, {"robot": {"joint_range_rad": ranges}})
    reading = JointReading(ended, make_kinematics(ended))
    joints = Joints(STAMP_NS, NAMES, np.array([*HOME_RAD[:5], -1.0]), None, None)
    taken = reading.take(joints, STAMP_NS)
    assert taken is not None
    assert taken.position_rad[5] == pytest.approx(TURN - 1.0)
    assert taken.endless == ENDLESS[:2]


def test_a_velocity_that_is_not_reported_is_that_of_the_turning() -> None:
    robot = Robot(REPORTED["from -pi to pi"])
    true_rad = np.array(HOME_RAD) + (math.pi - 0.005 - 3.0) * TURNS
    robot.reports(robot.said(true_rad))
    taken = robot.reports(robot.said(true_rad + 0.01 * TURNS))
    assert taken.velocity_rad_s[TURNS] == pytest.approx(0.01 / (PERIOD_NS / 1e9))


def test_a_state_names_the_joints_that_turn_without_an_end() -> None:
    assert Robot(REPORTED["counted"]).reports(np.array(HOME_RAD)).endless == ENDLESS


def test_a_robot_that_was_restarted_and_counts_from_elsewhere_does_not_jump() -> None:
    robot, there = Robot(REPORTED["counted"]), np.array(HOME_RAD)
    first = robot.reports(there).position_rad
    again = robot.reports(there - 9 * TURN * TURNS)
    assert again.position_rad == pytest.approx(first)
    assert first - robot.reading.turned_rad == pytest.approx(there - 9 * TURN * TURNS)


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e9, -3e5])
def test_garbage_is_still_rejected(garbage: float) -> None:
    robot, there = Robot(REPORTED["counted"]), np.array(HOME_RAD)
    robot.reports(there)
    with pytest.raises(CodecError, match=r"joint6|NaN or infinite"):
        robot.reports(np.array([*HOME_RAD[:5], garbage]))
    with pytest.raises(CodecError, match=r"joint6 at 1000 rad/s"):
        robot.reports(there, np.array([0.0] * 5 + [1e3]))
    assert robot.reports(there).position_rad == pytest.approx(there)


def test_a_frozen_state_is_still_rejected() -> None:
    reading = JointReading(PROFILE, KINEMATICS)
    joints = Joints(STAMP_NS, NAMES, np.array(HOME_RAD), None, None)
    reading.take(joints, STAMP_NS)
    with pytest.raises(CodecError, match="came again"):
        reading.take(joints, STAMP_NS)


ARM = """
from vla_zenoh.robot import Reading


class Wraps:
    def __init__(self):
        self.at, self.moved = [], []

    def read(self):
        return Reading(self.at)

    def move(self, command):
        self.moved.append(command.position_rad)
"""


def test_a_robot_class_is_moved_in_its_own_numbers(tmp_path: Path) -> None:
    (tmp_path / "wraps.py").write_text(ARM)
    here = {
        "arm": {"file": "wraps.py"},
        "cameras": {"front": None, "wrist": None},
        "hosts": {"here": {"nodes": ["router", "arm", "command", "worker"]}},
        "robot": {**PROFILE.robot.model_dump(mode="json"), "driver": "arm", "gripper": None},
        "limits": PROFILE.limits.model_dump(mode="json"),
    }
    (tmp_path / "lab.yaml").write_text(yaml.safe_dump({"extends": "panda_sim", **here}))
    driver = PythonDriver(load_profile(str(tmp_path / "lab.yaml")))
    Report(driver)
    robot, now_ns = driver.robot, 10**12
    for wrist in (3.1, -3.1, -3.0):
        robot.at, now_ns = [*HOME_RAD[:5], wrist], now_ns + 10**9
        measured = driver.read(now_ns)
    assert measured.joints.position_rad[5] == pytest.approx(TURN - 3.0)
    goal = np.array([*HOME_RAD[:5], TURN - 2.98])
    driver.move(JointReference.at_rest(goal), 0)
    assert robot.moved[-1] == pytest.approx([*HOME_RAD[:5], -2.98])
