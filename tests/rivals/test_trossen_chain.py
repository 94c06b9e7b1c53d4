"""A prompt moves trossen-arm-sim's WidowX AI through every node of a host."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, READY_PATIENCE_S, Chain, running_chain
from trossen_rig import Controller, bring_home

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.lab.demo.scripted_motions import STEP_M

PROFILE = """
extends: widowx_ai
trossen: {{address: 127.0.0.1}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: {patience_s[command]}, state_timeout_s: {patience_s[state]}}}
"""
STEPS, REACHED_M = 5, 1e-3
AGAIN_S = 30.0

pytestmark = pytest.mark.timeout(170)


class Lab(NamedTuple):
    """A chain, and the controller of its arm."""

    chain: Chain
    controller: Controller

    def tcp_m(self) -> np.ndarray:
        """Where the simulated arm has its TCP."""
        joints_rad = self.controller.joints_rad()[:6]
        return make_kinematics(self.chain.profile).forward(joints_rad).position_m


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("chain")
    path = folder / "lab.yaml"
    path.write_text(PROFILE.format(endpoint=free_endpoint(), patience_s=CHAIN_PATIENCE_S))
    with Controller() as controller:
        bring_home()
        with running_chain(folder, profile_file=path) as chain:
            chain.until("the arm is up", lambda: chain.state("arm") == "running", AGAIN_S)
            chain.recorder.only = {"state": "arm#", "command": "command#"}
            yield Lab(chain, controller)


def test_a_prompt_moves_the_arm_by_what_was_asked_for(lab: Lab) -> None:
    chain = lab.chain
    chain.activate_when_ready()
    for prompt, way_m in (("up", [0, 0, STEPS * STEP_M]), ("down", [0, 0, -STEPS * STEP_M])):
        before_m = lab.tcp_m()
        chain.client.set_prompt("hold")
        chain.client.set_prompt(f"HARD: go {prompt} x{STEPS}")
        chain.until(
            "the steps are carried out",
            lambda: chain.detail("policy_done") and chain.detail("accepted_steps") >= STEPS,
            AGAIN_S,
        )
        chain.wait_still()
        time.sleep(0.5)  # the simulated arm is 50 ms behind its targets
        went_m = lab.tcp_m() - before_m
        print(f"{prompt}: {np.round(1e3 * went_m, 3)} mm of {way_m}")
        np.testing.assert_allclose(went_m, way_m, atol=REACHED_M)


def test_the_router_killed_stops_the_arm(lab: Lab) -> None:
    chain = lab.chain
    chain.client.set_prompt("HARD: go up")
    chain.activate_when_ready()
    chain.until("the arm moves", chain.moves)
    pid = chain.pid("router")
    since_s = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    print(f"router: arm stood after {lab.controller.stood(since_s)} (s, rad)")
    chain.until(
        "the router runs again",
        lambda: chain.host.supervisor.pids().get("router", pid) != pid,
        READY_PATIENCE_S,
    )
