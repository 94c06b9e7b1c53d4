"""A prompt moves a UR5e through every node of a host; its controller is tests/ur_peer.py."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

pytest.importorskip("rtde_control", reason="needs the extra ur")

from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, Chain, running_chain
from ur_peer import NORMAL, PeerProcess

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import pose_distance
from vla_zenoh.lab.demo.scripted_motions import STEP_M, STEP_RAD

REACHED_M, REACHED_RAD = 1e-3, 2e-3
AGAIN_S = 30.0
# A busy computer stands still for longer than the robot's own watchdog usually allows; no test here
# looks at that.
PROFILE = """
extends: ur5e_rtde
ur: {{address: {address}, watchdog_hz: 1}}
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: {patience_s[command]}, state_timeout_s: {patience_s[state]}}}
"""

pytestmark = [pytest.mark.slow, pytest.mark.realtime, pytest.mark.timeout(180)]


class Lab(NamedTuple):
    """A chain and its robot."""

    chain: Chain
    robot: Any

    def fault(self) -> str:
        return str(self.chain.detail("fault", "arm") or "")


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    path = tmp_path / "lab.yaml"
    with PeerProcess(ctx=multiprocessing.get_context("spawn")) as process:
        robot = process.UrPeer()  # type: ignore[attr-defined]
        path.write_text(
            PROFILE.format(
                address=robot.where(), endpoint=free_endpoint(), patience_s=CHAIN_PATIENCE_S
            )
        )
        with running_chain(tmp_path, profile_file=path) as chain:
            chain.until(
                "the chain is up",
                lambda: chain.client.task is not None and chain.state("arm") == "running",
                AGAIN_S,
            )
            chain.recorder.only = {"state": "arm#", "command": "command#"}
            yield Lab(chain, robot)
        robot.close()


def test_a_prompt_moves_the_joints_of_the_robot_by_what_was_asked_for(lab: Lab) -> None:
    kinematics = make_kinematics(lab.chain.profile)
    lab.chain.activate_when_ready()
    for prompt, way_m, turn_rad in (
        ("go up", 5 * STEP_M, 0.0),
        ("yaw left", 0.0, 5 * STEP_RAD),
        ("go down", -5 * STEP_M, 0.0),
    ):
        start = kinematics.forward(np.array(lab.robot.look("q")))
        lab.chain.client.set_prompt("hold")
        lab.chain.client.set_prompt(f"HARD: {prompt} x5")
        lab.chain.until(
            "the steps are carried out",
            lambda: lab.chain.detail("policy_done") and lab.chain.detail("accepted_steps") >= 5,
            AGAIN_S,
        )
        lab.chain.wait_still()
        end = kinematics.forward(np.array(lab.robot.look("q")))
        np.testing.assert_allclose(end.position_m - start.position_m, [0, 0, way_m], atol=REACHED_M)
        assert pose_distance(start, end)[1] == pytest.approx(turn_rad, abs=REACHED_RAD)


def test_after_a_protective_stop_nothing_moves_until_a_person_resets_and_activates(
    lab: Lab,
) -> None:
    lab.chain.client.set_prompt("HARD: go up")
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
    lab.robot.protective_stop()
    lab.chain.until("the stop is a fault", lambda: "PROTECTIVE_STOP" in lab.fault())
    lab.chain.until("the chain is told", lambda: lab.chain.state() == "fault")
    lab.robot.put(safety_mode=NORMAL)
    stands = np.array(lab.robot.look("q"))
    lab.chain.client.set_prompt("HARD: go down")
    lab.chain.wait_still()
    np.testing.assert_allclose(lab.robot.look("q"), stands, atol=1e-6)
    lab.chain.client.reset()
    lab.chain.until("the reset is enough", lab.chain.client.cleared, AGAIN_S)
    assert not lab.fault()
    lab.chain.activate_when_ready()
    lab.chain.until("the arm moves", lab.chain.moves)
