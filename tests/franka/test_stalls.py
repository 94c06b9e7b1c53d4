"""The driver whose caller stands still, or asks for too much: where the arm rests, who holds it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import until
from franka_rig import Simulator, simulator
from vla_zenoh_franka.arm import REST_S, FrankaArm

from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation
from vla_zenoh.profile import load_profile
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand

SPEED_M_S, SPEED_RAD_S, RAMP_S, TICK_S = 0.2, 0.3, 0.4, 0.004
BEYOND_M, BEYOND_RAD = 3e-3, 6e-3
"""Friction, of which the last moments of a motion leave more than a settled arm has."""
SILENT_S = 0.8
KNOWN_S = 0.3
"""After this the state has the tool that was set."""
JOINT, WRIST = 3, 4
FAR_S, FAR_RAD = 1.5, 0.4
PROFILE = """
extends: fr3
franka: {{address: 127.0.0.1, realtime: ignore, hand: false}}
robot: {{command: {command}}}
"""

pytestmark = pytest.mark.timeout(120)


@pytest.fixture(scope="module")
def robot() -> Iterator[Simulator]:
    with simulator("--no-gripper") as running:
        yield running


@pytest.fixture(params=["pose", "joint"])
def arm(request: pytest.FixtureRequest, robot: Simulator, tmp_path: Path) -> Iterator[FrankaArm]:
    path = tmp_path / "lab.yaml"
    path.write_text(PROFILE.format(command=request.param))
    profile = load_profile(str(path))
    arm = FrankaArm(profile, profile.driver_options)
    arm.connect()
    until("it is configured", lambda: arm.read() and arm.status()["configured"])
    time.sleep(KNOWN_S)
    yield arm
    arm.close()


def way(duration_s: float, speed: float) -> tuple[float, float]:
    """Way and speed, `duration_s` after a motion began at rest."""
    ramp_s = min(duration_s, RAMP_S)
    return speed * (ramp_s**2 / (2 * RAMP_S) + duration_s - ramp_s), speed * ramp_s / RAMP_S


def move(arm: FrankaArm, duration_s: float) -> FloatArray:
    """Lead the arm up, or a joint, and stop calling in full motion; the last set-point."""
    state = arm.robot.state
    start, q = state.O_T_EE, np.array(state.q)
    begun_s = time.monotonic()
    while (elapsed_s := time.monotonic() - begun_s) < duration_s:
        arm.read()
        command: Any
        if arm._profile.robot.command == "pose":
            gone, speed = way(elapsed_s, SPEED_M_S)
            position = np.array(start.translation) + (0.0, 0.0, gone)
            twist = np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])
            quat = np.array(start.quaternion)
            command = PoseCommand(position, quat, twist, np.zeros(6), position, quat, "active")
            given = position
        else:
            gone, speed = way(elapsed_s, SPEED_RAD_S)
            given, rate = q.copy(), np.zeros(7)
            given[JOINT], rate[JOINT] = q[JOINT] + gone, speed
            names = arm._profile.robot.arm_joints
            command = JointCommand(names, given, rate, np.zeros(7), "active")
        arm.move(command)
        time.sleep(TICK_S)
    return given


def test_an_arm_whose_caller_stands_still_comes_to_rest_at_its_last_set_point(
    robot: Simulator, arm: FrankaArm
) -> None:
    since = len(robot.lines)
    given = move(arm, 0.8)
    time.sleep(SILENT_S)
    assert arm.robot.is_in_control, robot.aborts(since)
    state = arm.robot.state
    if arm._profile.robot.command == "pose":
        beyond, allowed = np.array(state.O_T_EE.translation) - given, BEYOND_M
    else:
        beyond, allowed = np.array(state.q) - given, BEYOND_RAD
    print(f"\n{1e3 * np.abs(beyond).max():.1f} mm or mrad beyond its set-point")
    assert np.abs(beyond).max() < allowed
    assert not robot.aborts(since)


def test_a_set_point_that_is_far_off_is_no_reflex(robot: Simulator, arm: FrankaArm) -> None:
    since, state = len(robot.lines), arm.robot.state
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < FAR_S:
        arm.read()
        command: Any
        if arm._profile.robot.command == "pose":
            position = np.array(state.O_T_EE.translation)
            turned = exp3(np.array([FAR_RAD, 0.0, 0.0])) @ state.O_T_EE.matrix[:3, :3]
            quat = quat_from_rotation(turned)
            still = np.zeros(6)
            command = PoseCommand(position, quat, still, still, position, quat, "active")
        else:
            wanted = np.array(state.q)
            wanted[WRIST] += FAR_RAD
            names = arm._profile.robot.arm_joints
            command = JointCommand(names, wanted, np.zeros(7), np.zeros(7), "active")
        arm.move(command)
        time.sleep(TICK_S)
    assert arm.robot.is_in_control, robot.aborts(since)
    moved = np.linalg.norm(np.array(arm.robot.state.q) - np.array(state.q))
    assert moved > FAR_RAD / 4
    assert not robot.aborts(since)


def test_an_arm_is_idle_before_and_after_its_loop_runs(robot: Simulator, arm: FrankaArm) -> None:
    assert arm.read().idle
    move(arm, 0.1)
    assert not arm.read().idle
    time.sleep(REST_S)
    until("the loop has ended", lambda: arm.read().idle)
