"""An arm of one's own in the whole chain: real nodes, and MuJoCo behind a Python file.

What happens to the arm is written into a file that the arm looks at; how it moved is what it
measured, on `state/pose`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import own_arm
import pytest
from chain import STILL_M_S, Chain, running_chain, write_profile

from vla_zenoh.lab.demo.scripted_motions import STEP_WIDTH_M

STEPS, STEP_M = 10, 0.01
ON_ITS_WAY_M = 0.02
"""This arm's controller is Python in the node's own process: where a busy computer stands still, so
does that, and is led on from where it drifted to."""
EXACT_M, WIDTH_M = 0.001, 0.002
QUIET_NS = 300_000_000
STANDS_S = 1.0
"""The watchdogs of a test's profile (0.35 s) and a brake."""
ARM_TOLERANCE = 2.7
"""As in tests/fault/test_dead_nodes.py: the arm brakes by itself when nobody commands."""
AGAIN_S = 20.0


@dataclass
class Lab:
    """The chain, and what ails the arm."""

    chain: Chain
    file: Path

    def trouble(self, what: str) -> None:
        self.file.write_text(what)

    def stands(self, since_ns: int) -> None:
        """The arm comes to rest in time."""

        def stood() -> bool:
            # It stands for a while: an arm on springs swings a little after it first did.
            track = self.chain.recorder.track()
            late = track.stamp_ns > track.stamp_ns[-1] - QUIET_NS
            return bool((track.speed_m_s[late] < STILL_M_S).all())

        self.chain.until("the arm stands", stood)
        assert self.chain.recorder.track().time_to_stand_s(since_ns) < STANDS_S

    def brakes(self, since_ns: int) -> None:
        """It does, and not by a jolt."""
        self.stands(since_ns)
        limit = self.chain.profile.limits.translation.acceleration_m_s2
        assert self.chain.recorder.track().hardest_change() < limit * ARM_TOLERANCE


@pytest.fixture(scope="module", params=["joint", pytest.param("pose", marks=pytest.mark.slow)])
def lab(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    twin = write_profile(folder, name="twin")
    trouble = folder / "trouble"
    trouble.write_text("")
    options = f"{{profile: {twin}, trouble: {trouble}}}"
    lab = folder / "lab.yaml"
    lab.write_text(
        f"extends: {twin}\n"
        f"robot: {{driver: arm, command: {request.param}}}\n"
        f"arm: {{file: {own_arm.__file__}, options: {options}}}\n"
        "cameras: {front: null}\n"
        "hosts: {here: {nodes: [router, arm, command, worker]}}\n"
    )
    with running_chain(folder, profile_file=lab, worker_options={"scripted": ["camera="]}) as chain:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        yield Lab(chain, trouble)


@pytest.fixture(autouse=True)
def _well(lab: Lab) -> None:
    lab.trouble("")
    lab.chain.until("the arm is there", lambda: lab.chain.state("arm") == "running", AGAIN_S)
    lab.chain.settle()
    lab.chain.recorder.forget()


def newest_ns(lab: Lab) -> int:
    return int(lab.chain.recorder.track().stamp_ns[-1])


def test_steps_that_are_asked_for_are_made_to_the_millimetre(lab: Lab) -> None:
    chain = lab.chain
    chain.activate_when_ready()
    chain.wait_still()
    start_m = chain.height_m()
    for direction, wanted_m in (("up", start_m + STEPS * STEP_M), ("down", start_m)):
        chain.go(direction, STEPS)
        # A measured arm settles a little longer than what it is told.
        chain.until(
            f"{wanted_m:.4f} m",
            lambda wanted_m=wanted_m: abs(chain.height_m() - wanted_m) < EXACT_M,
        )
    track = chain.recorder.track()
    aside_m = np.abs(track.position_m[:, :2] - track.position_m[0, :2])
    assert aside_m[-1].max() < EXACT_M
    assert aside_m.max() < ON_ITS_WAY_M
    assert chain.counter("arm.commands_given", "arm") > 0


@pytest.mark.slow
def test_the_gripper_goes_where_it_is_asked_to(lab: Lab) -> None:
    chain = lab.chain
    chain.activate_when_ready()
    before_m = width_m(lab)
    for prompt, way_m in (("close", -STEP_WIDTH_M), ("open", 0.0)):
        chain.client.set_prompt(f"HARD: {prompt} gripper x1")
        wanted_m = before_m + way_m
        chain.until(
            f"{wanted_m:.3f} m", lambda wanted_m=wanted_m: abs(width_m(lab) - wanted_m) < WIDTH_M
        )


def width_m(lab: Lab) -> float:
    """As the arm measured it."""
    return float(lab.chain.detail("width_m", "arm"))


@pytest.mark.parametrize("what", ["fault", pytest.param("reflex", marks=pytest.mark.slow)])
def test_a_fault_of_the_robot_stops_it_until_it_is_gone_and_reset(lab: Lab, what: str) -> None:
    chain = lab.chain
    chain.move()
    since_ns = newest_ns(lab)
    lab.trouble(what)
    chain.until("fault", lambda: chain.state() == "fault")
    if what == "reflex":  # else nobody sees how the arm moves
        lab.trouble("")
    lab.stands(since_ns)  # by what the robot itself does
    assert any("user stop" in event.why for event in chain.events("robot_fault"))
    lab.trouble("")
    chain.until("the robot is well", lambda: chain.state("arm") == "running")
    assert chain.state() == "fault"
    chain.client.reset()
    chain.until("it is reset", chain.client.cleared)
    chain.activate_when_ready()


@pytest.mark.parametrize("what", [pytest.param("frozen", marks=pytest.mark.slow), "nan"])
def test_without_a_state_that_can_be_believed_the_arm_brakes(lab: Lab, what: str) -> None:
    chain = lab.chain
    chain.move()
    lab.trouble(what)
    chain.until("it is told", lambda: chain.state("arm") == "silent")
    chain.until("inactive", lambda: chain.state() == "inactive")
    chain.recorder.forget()  # what is known is from before: it moved
    lab.trouble("")
    chain.until("running", lambda: chain.state("arm") == "running")
    chain.until("it is heard again", lambda: len(chain.recorder.track().stamp_ns) > 0)
    lab.brakes(int(chain.recorder.track().stamp_ns[0]))
    assert (chain.refused().get("arm.invalid", 0) > 0) == (what == "nan")


@pytest.mark.slow
@pytest.mark.parametrize("what", ["raise", "raise once"])
def test_an_arm_that_raises_is_braked_and_started_again(lab: Lab, what: str) -> None:
    chain = lab.chain
    chain.move()
    pid = chain.pid("arm")
    lab.trouble(what)
    chain.until("its node ends", lambda: chain.host.supervisor.pids().get("arm") != pid)
    lab.trouble("")
    chain.until("it is back", lambda: is_back(chain, pid), AGAIN_S)
    assert chain.state() != "active"
    assert not chain.moves()
    assert any("the cable is out" in line for node, line in chain.lines if node == "arm")
    chain.activate_when_ready()


def is_back(chain: Chain, pid: int) -> bool:
    """Another process than `pid` runs the arm: the status is not the last one of `pid`."""
    status = chain.client.status("arm")
    return status is not None and status.state == "running" and status.pid != pid


def test_an_arm_that_waits_in_move_is_told_so_and_stands(lab: Lab) -> None:
    chain = lab.chain
    chain.move()
    lab.trouble("slow")
    chain.until("stalled", lambda: chain.counter("arm.stalls", "arm") > 0)
    lab.trouble("")
    chain.until("the arm stands", lambda: not chain.moves() and chain.state() != "active")
    assert any("my_arm" in e.why or "own_arm.py" in e.why for e in chain.events("running->stalled"))


@pytest.mark.slow
def test_an_arm_that_takes_long_to_connect_is_not_taken_for_one_that_hangs(lab: Lab) -> None:
    chain = lab.chain
    lab.trouble("far away")
    pid = chain.pid("arm")
    os.kill(pid, signal.SIGKILL)
    chain.until("it connects", lambda: chain.state("arm") == "connecting", AGAIN_S)
    again = chain.pid("arm")
    chain.until("it is there", lambda: chain.state("arm") == "running", own_arm.CONNECT_S + AGAIN_S)
    assert chain.pid("arm") == again != pid
