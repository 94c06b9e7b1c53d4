"""franka-node itself behind every node of a host: motion, hand, reflex, and what is lost."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import NamedTuple

import pytest
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, Chain, running_chain
from franka_node_rig import NODE, Client, FrankaNode

from tests.franka import franka_rig
from vla_zenoh.kinematics.so3 import held_pose, pose_distance, pose_of
from vla_zenoh.lab.demo.scripted_motions import STEP_M

PROFILE = """
extends: fr3_franka_node
franka_node: {{endpoint: "{endpoint}"}}
limits:
  workspace: {{z_m: [0.012, 0.95]}}
  contact: {{effort_slow_nm: null, effort_stop_nm: null}} # franka-sim reports zeros
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: {patience_s[command]}, state_timeout_s: {patience_s[state]}}}
"""
STEPS, NEAR_M = 4, 0.01
BRICK_M, EXACT_M = 0.04, 0.003
FROZEN_S, SETTLE_S, AGAIN_S = 1.0, 2.5, 40.0

pytestmark = [
    pytest.mark.timeout(170),
    pytest.mark.skipif(NODE not in os.environ, reason=f"needs franka-node itself in {NODE}"),
]


class Lab(NamedTuple):
    """The chain, and the node that its arm node drives."""

    chain: Chain
    node: FrankaNode
    endpoint: str

    def fault(self) -> str:
        return self.chain.detail("fault", "arm") or ""

    def up(self) -> None:
        """Wait until the arm is there, and no fault is left."""
        chain = self.chain
        chain.until("the arm is there", lambda: chain.state("arm") in ("running", "fault"), AGAIN_S)
        if chain.state() in ("fault", "stopped"):
            chain.client.reset()
            chain.until("the reset is enough", chain.client.cleared, AGAIN_S)
        chain.settle()

    def way(self, prompt: str) -> float:
        """Carry out `STEPS` steps of a prompt; how much higher the arm is."""
        chain = self.chain
        before_m = chain.height_m()
        chain.client.set_prompt("hold")
        chain.client.set_prompt(f"HARD: {prompt} x{STEPS}")
        chain.until(
            "the steps are carried out",
            lambda: chain.detail("policy_done") and chain.detail("accepted_steps") >= STEPS,
            AGAIN_S,
        )
        chain.wait_still()
        time.sleep(SETTLE_S)
        return chain.height_m() - before_m

    def in_motion(self) -> int:
        """Move the arm up; the time, ns."""
        chain = self.chain
        chain.client.set_prompt("HARD: go up x8")
        chain.activate_when_ready()
        chain.until("the arm moves", chain.moves)
        return time.time_ns()

    def stands(self, since_ns: int) -> float:
        """After which time it stood, s."""
        self.chain.until("it stands", lambda: not self.chain.moves())
        time.sleep(1.0)
        return self.chain.recorder.track().time_to_stand_s(since_ns)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder, endpoint = tmp_path_factory.mktemp("fr3"), free_endpoint()
    path = folder / "lab.yaml"
    path.write_text(PROFILE.format(endpoint=endpoint, patience_s=CHAIN_PATIENCE_S))
    with ExitStack() as stack:
        given = ("--gripper-object-width", str(BRICK_M))
        stack.enter_context(franka_rig.simulator(*given))
        chain = stack.enter_context(running_chain(folder, profile_file=path))
        # It ends where no router answers.
        node = stack.enter_context(FrankaNode(endpoint, folder, 'gripper = "hand"'))
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        yield Lab(chain, node, endpoint)


@pytest.fixture
def lab(running: Lab) -> Lab:
    running.up()
    return running


def test_a_prompt_moves_the_arm_there_and_back(lab: Lab) -> None:
    lab.chain.activate_when_ready()
    for prompt, sign in (("go down", -1), ("go up", 1)):
        went_m = lab.way(prompt)
        state = lab.chain.measured()
        apart_m, _ = pose_distance(pose_of(state), held_pose(state))
        off_m = went_m - sign * STEPS * STEP_M
        print(f"{prompt}: {1e3 * off_m:.2f} mm off; from its set-point {1e3 * apart_m:.2f} mm")
        assert abs(off_m) < NEAR_M
        assert apart_m < NEAR_M
    assert not lab.fault()


def test_its_hand_grasps_what_is_between_the_fingers(lab: Lab) -> None:
    chain = lab.chain
    chain.activate_when_ready()
    chain.client.pop_events()
    chain.client.set_prompt("HARD: close gripper x2")
    chain.until("the grasp is told", lambda: chain.events("grasped"), AGAIN_S)
    chain.client.set_prompt("HARD: open gripper x2")
    chain.until("it is let go", lambda: chain.detail("policy_done"), AGAIN_S)
    assert not chain.events("object_lost")
    assert not lab.fault()


def test_a_reflex_is_a_fault_with_its_reason_and_a_reset_recovers(lab: Lab) -> None:
    lab.in_motion()
    os.kill(lab.node.pid, signal.SIGSTOP)
    since_s = time.monotonic()
    time.sleep(FROZEN_S)
    os.kill(lab.node.pid, signal.SIGCONT)
    lab.chain.until("the fault is told", lab.fault, AGAIN_S)
    print(f"told {time.monotonic() - since_s:.2f} s after it froze: {lab.fault()}")
    lab.chain.until("nobody obeys", lambda: lab.chain.state() in ("fault", "inactive"))
    lab.up()
    lab.chain.activate_when_ready()
    assert abs(lab.way("go down") + STEPS * STEP_M) < NEAR_M


def test_a_second_commander_is_refused_and_the_motion_goes_on(lab: Lab) -> None:
    with Client(lab.endpoint, "fr3") as client:
        lab.in_motion()
        assert client.ask(verb="acquire")["said"].startswith("held by ")
        assert "not the holder" in client.ask(verb="drive")["said"]
        assert lab.chain.state() == "active"
        assert not lab.fault()


def test_the_command_node_killed_stops_the_arm(lab: Lab) -> None:
    since_ns = lab.in_motion()
    os.kill(lab.chain.pid("command"), signal.SIGKILL)
    print(f"kill -9 of the command node: stands after {lab.stands(since_ns):.2f} s")
