"""An FR3 that speaks FCI, moved by prompts through the whole chain; the simulator judges."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chain import command_line
from franka_lab import REACHED_M, REACHED_RAD, Lab, running_lab

from vla_zenoh.kinematics.so3 import pose_distance, pose_of
from vla_zenoh.lab.demo.scripted_motions import STEP_RAD

AGAIN_S = 30.0

pytestmark = pytest.mark.timeout(200)


@pytest.fixture(scope="module", params=["pose", "joint"])
def running(request: pytest.FixtureRequest, tmp_path_factory: Any) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("fr3"), request.param) as lab:
        yield lab


@pytest.fixture
def lab(running: Lab) -> Lab:
    if running.chain.state() in ("fault", "stopped"):
        running.go_on()
    running.chain.settle()
    return running


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0])
def test_a_prompt_moves_the_arm_there_and_back_without_a_reflex(lab: Lab, rate_hz: float) -> None:
    since = len(lab.robot.lines)
    lab.chain.client.set_rate(rate_hz)
    lab.chain.activate_when_ready()
    start = lab.chain.measured()
    for prompt in ("go down", "go up"):
        apart_m, apart_rad = lab.way(prompt, 4)
        assert apart_m < REACHED_M, lab.share(since)
        assert apart_rad < REACHED_RAD, lab.share(since)
    back = lab.chain.measured()
    assert not lab.robot.aborts(since), lab.share(since)
    assert not lab.fault()
    assert pose_distance(pose_of(start), pose_of(back))[0] < 4 * REACHED_M
    print(
        f"\n{rate_hz:g} Hz: {1e3 * apart_m:.2f} mm, {1e3 * apart_rad:.2f} mrad;", lab.share(since)
    )


def test_rotations_turn_the_tcp_by_what_was_asked_for(lab: Lab) -> None:
    since = len(lab.robot.lines)
    lab.chain.activate_when_ready()
    for there, back in (("yaw left", "yaw right"), ("pitch down", "pitch up")):
        before = lab.chain.measured()
        lab.way(there, 3)
        turned_rad = pose_distance(pose_of(before), pose_of(lab.chain.measured()))[1]
        assert turned_rad == pytest.approx(3 * STEP_RAD, abs=2 * REACHED_RAD)
        lab.way(back, 3)
    assert not lab.robot.aborts(since), lab.share(since)


def test_a_stop_in_motion_is_no_reflex(lab: Lab) -> None:
    since = len(lab.robot.lines)
    lab.chain.client.set_prompt("HARD: go down x8")
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
    stop_ns = time.time_ns()
    lab.chain.client.stop()
    lab.chain.until("it is stopped", lambda: lab.chain.state() == "stopped")
    lab.chain.wait_still()
    assert lab.chain.recorder.track().time_to_stand_s(stop_ns) < 1.5
    assert not lab.robot.aborts(since), lab.share(since)


def test_a_command_node_that_is_killed_in_motion_brakes_the_arm_without_a_reflex(lab: Lab) -> None:
    since = len(lab.robot.lines)
    lab.chain.client.set_prompt("HARD: go down x8")
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
    os.kill(lab.chain.pid("command"), signal.SIGKILL)
    lab.chain.until("the arm stands", lambda: not lab.chain.moves())
    assert not lab.robot.aborts(since), lab.share(since)
    lab.go_on()


def test_an_arm_node_that_stands_still_in_motion_is_a_reflex_that_only_a_person_ends(
    lab: Lab,
) -> None:
    since = len(lab.robot.lines)
    lab.chain.client.set_prompt("HARD: go down x8")
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
    pid = lab.chain.pid("arm")
    os.kill(pid, signal.SIGSTOP)
    time.sleep(1.0)
    os.kill(pid, signal.SIGCONT)
    lab.chain.until("the reflex is told", lambda: "communication_constraints" in lab.fault())
    assert any("communication_constraints_violation" in line for line in lab.robot.aborts(since))
    assert lab.chain.state() in ("fault", "inactive")
    lab.chain.until("the robot has braked", lambda: not lab.chain.moves())
    there = lab.chain.measured().position_m
    time.sleep(1.5)
    np.testing.assert_allclose(lab.chain.measured().position_m, there, atol=1e-3)
    assert lab.fault()
    once = command_line("reset", profile=lab.chain.profile_file)
    assert once.returncode == 0, once.stderr
    lab.chain.until(
        "nothing is latched", lambda: (lab.fault(), lab.chain.state()) == ("", "inactive")
    )
    lab.go_on()
    since = len(lab.robot.lines)
    lab.way("go up", 3)
    assert not lab.robot.aborts(since), lab.share(since)


def test_an_arm_node_that_is_killed_in_motion_comes_back_and_moves_nothing_by_itself(
    lab: Lab,
) -> None:
    lab.chain.client.set_prompt("HARD: go down x8")
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
    killed = lab.chain.pid("arm")
    os.kill(killed, signal.SIGKILL)
    lab.chain.until(
        "another one runs",
        lambda: (
            lab.chain.host.supervisor.pids().get("arm") not in (None, killed)
            and lab.chain.state("arm") in ("running", "fault")
        ),
        AGAIN_S,
    )
    since_ns = time.time_ns()  # it says that it runs before the first of its states
    lab.chain.until(
        "its states come", lambda: lab.chain.recorder.track(since_ns).stamp_ns.size > 20
    )
    there = lab.chain.measured().position_m
    time.sleep(1.5)
    np.testing.assert_allclose(lab.chain.measured().position_m, there, atol=1e-3)
    lab.go_on()
    since = len(lab.robot.lines)
    lab.way("go up", 3)
    assert not lab.robot.aborts(since), lab.share(since)
