"""A DDS robot, the real bridge and our nodes: does the arm do what the model says?

Everything said of the motion is what a witness saw in DDS.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from rig import Lab

ros = pytest.importorskip("ros_messages", exc_type=ImportError)
pytestmark = pytest.mark.ros2

STEP_M, WIDTH_STEP_M = 0.01, 0.05
WAY_TOLERANCE_M = 0.002
SIDEWAYS_M = 0.002
WIDTH_TOLERANCE_M = 0.003
SILENCE_S = 0.15
"""timing.state_timeout_s of the profile."""
NOTICE_S = 0.25
"""What a tick, the bridge and a busy machine may add to it."""
BRAKE_WAY_M = 0.06
"""0.15 m/s for the time until it is noticed, and the brake."""
DDS_TIMEOUT_S = 5.0
GRIPPER_S = 10.0


def test_ten_steps_up_lift_the_dds_robot_by_ten_centimetres(lab: Lab) -> None:
    began_m = lab.activate_at_rest()
    lab.chain.go("up", 10)
    ended_m = lab.witness.wait_still()
    assert ended_m - began_m == pytest.approx((0, 0, 10 * STEP_M), abs=WAY_TOLERANCE_M)


@pytest.mark.slow
def test_fifty_steps_up_at_5_hz_end_within_two_millimetres(lab: Lab) -> None:
    lab.go_down_to(0.2)
    lab.chain.client.set_rate(5.0)
    began_m = lab.activate_at_rest()
    began_s = time.monotonic()
    lab.chain.go("up", 50, timeout_s=30.0)
    took_s = time.monotonic() - began_s
    ended_m = lab.witness.wait_still()
    print(f"\n50 x 'HARD: go up': {1e3 * (ended_m - began_m)} mm in {took_s:.1f} s")
    assert ended_m[2] - began_m[2] == pytest.approx(50 * STEP_M, abs=WAY_TOLERANCE_M)
    assert np.abs(ended_m[:2] - began_m[:2]).max() < SIDEWAYS_M
    assert took_s > 50 / 5.0


@pytest.mark.slow
def test_the_gripper_action_moves_the_robots_fingers(lab: Lab) -> None:
    lab.activate_at_rest()
    lab.chain.client.set_prompt("HARD: close gripper x1")
    lab.chain.until(
        "the fingers closed by one step",
        lambda: abs(lab.witness.width_m() - (0.08 - WIDTH_STEP_M)) < WIDTH_TOLERANCE_M,
        GRIPPER_S,
    )
    lab.chain.client.set_prompt("HARD: open gripper x1")
    lab.chain.until(
        "the fingers opened again",
        lambda: abs(lab.witness.width_m() - 0.08) < WIDTH_TOLERANCE_M,
        GRIPPER_S,
    )


def test_a_dds_client_sets_prompt_and_activation(lab: Lab) -> None:
    node = lab.witness.node
    set_active = node.client("/vla/set_active", ros.SetBoolRequest, ros.SetBoolResponse)
    set_prompt = node.client("/vla/set_prompt", ros.SetPromptRequest, ros.SetPromptResponse)
    began_m = lab.witness.wait_still()

    assert set_prompt.call("hold", timeout_s=DDS_TIMEOUT_S).success
    said = set_active.call(True, timeout_s=DDS_TIMEOUT_S)
    assert said.success, said.message
    lab.chain.until("active", lambda: lab.chain.state() == "active")
    said = set_prompt.call("HARD: go up x5", timeout_s=DDS_TIMEOUT_S)
    assert said.success, said.message
    lab.chain.wait_done("HARD: go up x5", 5)
    lab.chain.wait_still()
    ended_m = lab.witness.wait_still()
    assert ended_m[2] - began_m[2] == pytest.approx(5 * STEP_M, abs=WAY_TOLERANCE_M)

    said = set_prompt.call("x" * 100_000, timeout_s=DDS_TIMEOUT_S)
    assert not said.success
    assert said.message
    assert lab.chain.client.task is not None
    assert lab.chain.client.task.prompt == "HARD: go up x5"
    assert set_active.call(False, timeout_s=DDS_TIMEOUT_S).success
    lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")


@pytest.mark.slow
def test_a_dds_client_stops_and_resets(lab: Lab) -> None:
    node = lab.witness.node
    stop = node.client("/vla/stop", ros.TriggerRequest, ros.TriggerResponse)
    reset = node.client("/vla/reset", ros.TriggerRequest, ros.TriggerResponse)
    request = node.client("/vla/set_request", ros.SetRequestRequest, ros.SetRequestResponse)
    lab.chain.wait_still()

    said = request.call("HARD: go down", "scripted", 5.0, True, timeout_s=DDS_TIMEOUT_S)
    assert said.success, said.message
    lab.chain.until("it moves", lambda: lab.witness.speed_m_s() > 0.02)
    assert stop.call(timeout_s=DDS_TIMEOUT_S).success
    lab.witness.wait_still(2.0)
    assert lab.chain.state() == "stopped"
    refused = request.call("hold", "scripted", 5.0, True, timeout_s=DDS_TIMEOUT_S)
    assert not refused.success
    assert reset.call(timeout_s=DDS_TIMEOUT_S).success
    lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")


@pytest.mark.slow
def test_a_robot_that_falls_silent_is_noticed_within_the_watchdog(lab: Lab) -> None:
    lab.move()
    lab.chain.client.pop_events()
    lab.robot.freeze()
    silent_ns = time.time_ns()
    try:
        lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")
        noticed_s = lab.when("active->inactive", silent_ns)
        print(f"\na silent robot is noticed after {noticed_s:.3f} s")
        assert noticed_s < SILENCE_S + NOTICE_S
        lab.chain.until("the command node's own brake is over", lambda: lab.chain.detail("at_rest"))
        told_m = lab.witness.goals(silent_ns)[1]
        assert np.linalg.norm(told_m[-1] - told_m[0]) < BRAKE_WAY_M
    finally:
        lab.robot.thaw()
    # What was sent while it hung ends its motion: where the brake ended, and nowhere else.
    time.sleep(1.0)
    assert lab.witness.wait_still() == pytest.approx(told_m[-1], abs=WAY_TOLERANCE_M)
    assert lab.chain.state() == "inactive"
    stood_m = lab.witness.position_m()
    assert lab.activate_at_rest() == pytest.approx(stood_m, abs=WAY_TOLERANCE_M)


def test_what_the_robot_says_arrives_as_it_was_said(lab: Lab) -> None:
    """The TCP that our node computes of /joint_states is where the robot's own node says it is."""
    at_m = lab.witness.wait_still()
    measured = lab.chain.measured().position_m
    assert measured == pytest.approx(at_m, abs=1e-4)
