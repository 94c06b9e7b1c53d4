"""A process that dies or stands still in motion, and a cable that is pulled: nothing goes on alone.

    .venv/bin/python scripts/test_franka.py -s -m slow -k test_lost

Each test prints what ended the motion, after which time the arm stood, and what was told.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from franka_lab import FAR_PORT, Lab, running_lab
from franka_rig import simulator

STILL_S, STILL_M = 1.5, 1e-3
STOPPED_S = 1.0
STANDS_S = 2.5
"""From the fault until the arm stands, at most."""
BACK_S = 60.0
STEPS = 3

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def running(tmp_path_factory: Any) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("fr3"), "joint", with_cable=True) as lab:
        yield lab


@pytest.fixture
def lab(running: Lab) -> Lab:
    running.go_on()
    running.chain.settle()
    running.chain.client.pop_events()
    running.chain.recorder.forget()
    running.chain.move()
    return running


def whole(lab: Lab) -> None:
    """Wait until every node is there."""
    nodes = ("arm", "command", "worker-scripted")
    lab.chain.until(
        "every node is there",
        lambda: (
            all(lab.chain.state(node) not in ("", "ended", "connecting") for node in nodes)
            and set(nodes) <= lab.chain.client.alive
        ),
        BACK_S,
    )


def stands_alone(lab: Lab) -> None:
    """The arm stands, and nobody moves it."""
    lab.chain.until("the arm stands", lambda: not lab.chain.moves(), BACK_S)
    time.sleep(0.5)
    there = lab.chain.measured().position_m
    time.sleep(STILL_S)
    np.testing.assert_allclose(lab.chain.measured().position_m, there, atol=STILL_M)
    assert lab.chain.state() != "active"


def tell(lab: Lab, what: str, since: int, began_ns: int) -> float:
    """Print what happened; how long the arm moved on, as far as it was heard (s)."""
    stood_s = lab.chain.recorder.track(began_ns).time_to_stand_s(began_ns)
    told = [f"{node}: {event.why}" for node, _, event in lab.chain.client.pop_events()]
    told = [words for words in told if words.startswith("arm: ")]
    robot = "; ".join(line.split("aborting")[0][-90:] for line in lab.robot.aborts(since)[:1])
    why = lab.chain.detail("why")
    print(
        f"\n{what}: stands after {stood_s:.2f} s; robot: {robot or 'no reflex'}; arm: "
        f"{lab.fault() or 'no fault'}; command: {lab.chain.state()}, {why}; "
        f"told: {told}; {lab.share(since)}"
    )
    return stood_s


def goes_on(lab: Lab) -> None:
    """One reset where there is a fault, one activation, and the arm moves as it did."""
    lab.go_on()
    since = len(lab.robot.lines)
    lab.chain.client.set_prompt("hold")
    lab.way("go up" if lab.chain.height_m() < 0.4 else "go down", STEPS)
    assert not lab.robot.aborts(since), lab.share(since)


@pytest.mark.parametrize("pulled_ms", [5, 30, 1000])
def test_a_cable_that_is_pulled_in_motion(lab: Lab, pulled_ms: int) -> None:
    assert lab.cable is not None
    since, began_ns = len(lab.robot.lines), time.time_ns()
    node = lab.chain.pid("arm")
    lab.cable.pull(pulled_ms / 1e3)
    if pulled_ms < 20:  # cycles, which the robot tolerates
        time.sleep(0.5)
        assert not lab.fault()
        assert lab.chain.state() == "active"
        assert lab.chain.moves()
        assert not lab.robot.aborts(since)
        lab.chain.client.deactivate()
        tell(lab, f"cable pulled for {pulled_ms} ms", since, began_ns)
        return
    lab.chain.until(
        "the fault is told, or the node starts again",
        lambda: lab.fault() or lab.chain.host.supervisor.pids().get("arm") not in (None, node),
        BACK_S,
    )
    whole(lab)
    stands_alone(lab)
    stood_s = tell(lab, f"cable pulled for {pulled_ms} ms", since, began_ns)
    assert stood_s < STANDS_S
    assert lab.chain.state() in ("fault", "inactive")
    goes_on(lab)


@pytest.mark.parametrize("how", ["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("node", ["worker-scripted", "command", "arm", "router"])
def test_a_node_that_dies_or_stands_still_in_motion(lab: Lab, node: str, how: str) -> None:
    since, pid = len(lab.robot.lines), lab.chain.pid(node)
    began_ns = time.time_ns()
    os.kill(pid, signal.Signals[how])
    if how == "SIGSTOP":
        time.sleep(STOPPED_S)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    else:
        lab.chain.until(
            "it runs again",
            lambda: lab.chain.host.supervisor.pids().get(node) not in (None, pid),
            BACK_S,
        )
    whole(lab)
    stands_alone(lab)
    stood_s = tell(lab, f"{how} of {node}", since, began_ns)
    if node == "arm":
        assert lab.fault() or how == "SIGKILL"
    else:
        assert not lab.robot.aborts(since), lab.share(since)
        assert not lab.fault()
        assert stood_s < STANDS_S
    goes_on(lab)


def test_a_robot_that_stands_still_in_motion(lab: Lab) -> None:
    since, began_ns = len(lab.robot.lines), time.time_ns()
    lab.robot.freeze()
    time.sleep(STOPPED_S)
    lab.robot.go_on()
    whole(lab)
    # It looks blocked: once it follows again it goes back a little, as it measures no contact.
    lab.chain.until("the retreat ends", lambda: lab.chain.events("retreat"), BACK_S)
    stands_alone(lab)
    tell(lab, "SIGSTOP of the simulator", since, began_ns)
    assert lab.chain.state() in ("fault", "inactive")
    goes_on(lab)


def test_a_robot_that_is_gone_in_motion_and_comes_back(lab: Lab, tmp_path: Path) -> None:
    since, began_ns = len(lab.robot.lines), time.time_ns()
    lab.robot.kill()
    lab.chain.until(
        "the fault is told, or the node is gone",
        lambda: lab.fault() or lab.chain.state("arm") in ("silent", "ended", "connecting"),
        BACK_S,
    )
    tell(lab, "SIGKILL of the simulator", since, began_ns)
    gone = lab.robot
    with simulator("--no-gripper", port=FAR_PORT) as lab.robot:
        whole(lab)
        stands_alone(lab)
        goes_on(lab)
        lab.chain.settle()
    lab.robot = gone
