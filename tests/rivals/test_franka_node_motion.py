"""Our driver moves franka-sim's FR3 through franka-rs's loop, and each side is killed in motion.

The node between them is franka-node where FRANKA_NODE names it, else our stand-in
(franka_node_process.py).
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import franka_node_peer as peer
import pytest
import zenoh
from camera_rig import free_endpoint, until
from franka_node_rig import Client, FrankaProcess, node
from physicalai_rig import Process
from vla_zenoh_franka_node import wire

from tests.franka import franka_rig

DRIVER = Path(__file__).with_name("driver_process.py")
PROFILE = """
extends: fr3_franka_node
robot: {{command: {command}}}
franka_node: {{endpoint: "{endpoint}"}}
"""
APART_M, APART_RAD = 0.01, 0.03
"""Friction of the simulated joints, against the node's soft springs."""
IN_MOTION_S, STANDS_S, STANDS_M_S = 1.2, 1.0, 0.002
LATEST_S = 8.0

pytestmark = pytest.mark.timeout(170)


class Watch:
    """Somebody who records the states of the arm."""

    def __init__(self, endpoint: str) -> None:
        self._session = peer.opened(mode="client", connect__endpoints=[endpoint])
        self.rows: list[tuple[float, float, str, int]] = []
        self._states = self._session.declare_subscriber("franka/fr3/state", self._keep)

    def _keep(self, sample: zenoh.Sample) -> None:
        state = wire.decode_state(sample.payload.to_bytes())
        row = (time.monotonic(), float(state.ee[2, 3]), state.phase, state.holder)
        self.rows.append(row)

    def stood(self, since_s: float) -> tuple[float, float]:
        """After which time from `since_s` on the arm stands, and how far it went on."""
        end_s = time.monotonic() + LATEST_S
        while time.monotonic() < end_s:
            time.sleep(0.2)
            rows = [row for row in self.rows if row[0] >= since_s]
            if not rows or rows[-1][0] - rows[0][0] < STANDS_S:
                continue
            last_m = rows[-1][1]
            moving = [row[0] for row in rows if abs(row[1] - last_m) > STANDS_M_S * STANDS_S]
            if not moving:
                return 0.0, abs(last_m - rows[0][1])
            if rows[-1][0] - moving[-1] > STANDS_S:
                return moving[-1] - since_s, abs(last_m - rows[0][1])
        raise AssertionError("it went on and on")

    def until(self, phase: str, holder: int, since_s: float) -> float:
        """After which time from `since_s` on the node was so."""
        end_s = time.monotonic() + LATEST_S
        while time.monotonic() < end_s:
            for at_s, _, was, who in list(self.rows):
                if at_s >= since_s and (was, who) == (phase, holder):
                    return at_s - since_s
            time.sleep(0.05)
        raise AssertionError((phase, holder, self.rows[-1:]))

    def close(self) -> None:
        self._session.close()


class Lab:
    """Simulator, router, node, and our driver's process."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder, self.endpoint = stack, folder, free_endpoint()
        self.router = stack.enter_context(FrankaProcess("router", self.endpoint))
        self.node = stack.enter_context(node(self.endpoint, folder))
        self.watch = Watch(self.endpoint)
        stack.callback(self.watch.close)
        until("the node serves the arm", lambda: self.watch.rows, LATEST_S)

    def start(self, command: str = "pose") -> None:
        """Start the driver."""
        profile = self._folder / "lab.yaml"
        profile.write_text(PROFILE.format(command=command, endpoint=self.endpoint))
        self.driver = Process(str(profile), python=sys.executable, script=DRIVER)
        self._stack.callback(self.driver.kill)

    def told(self, event: str) -> dict[str, Any]:
        """The driver's next line, which is `event`."""
        told = json.loads(self.driver.line())
        assert told["event"] == event, told
        return told

    def in_motion(self) -> float:
        """Wait until the arm is in motion; the time."""
        self.told("ready")
        self.told("moving")
        time.sleep(IN_MOTION_S)
        return time.monotonic()


@pytest.fixture(scope="module")
def simulator() -> Iterator[franka_rig.Simulator]:
    with franka_rig.simulator("--no-gripper") as simulator:
        yield simulator


@pytest.fixture
def lab(simulator: franka_rig.Simulator, tmp_path: Path) -> Iterator[Lab]:
    since = len(simulator.lines)
    with ExitStack() as stack:
        yield Lab(stack, tmp_path)
    print(f"simulator at {simulator.realtime_share(since):.2f} of real time")


@pytest.mark.parametrize("command", ["pose", "joint"])
def test_the_arm_rests_where_its_command_ended(lab: Lab, command: str) -> None:
    lab.start(command)
    lab.in_motion()
    there = lab.told("there")
    print(command, there)
    assert there["apart_m"] < APART_M
    assert there["apart_rad"] < APART_RAD
    assert there["detail"]["refused"] == there["detail"]["not_sent"] == 0


def test_our_driver_killed_stops_the_arm(lab: Lab) -> None:
    lab.start()
    since_s = lab.in_motion()
    lab.driver.kill()
    lost_s = lab.watch.until("idle", 0, since_s)
    print(f"lease lost after {lost_s:.2f} s, arm stood after {lab.watch.stood(since_s)}")


def test_our_driver_frozen_stops_the_arm(lab: Lab) -> None:
    lab.start()
    since_s = lab.in_motion()
    os.kill(lab.driver.pid, signal.SIGSTOP)
    lost_s = lab.watch.until("idle", 0, since_s)
    print(f"lease lost after {lost_s:.2f} s, arm stood after {lab.watch.stood(since_s)}")


def test_the_node_killed_ends_our_node(lab: Lab) -> None:
    lab.start()
    since_s = lab.in_motion()
    lab.node.kill()
    lost = lab.told("lost")
    print(f"lost after {lost['at_s'] - since_s:.2f} s: {lost['why']}")


def test_the_router_killed_ends_our_node(lab: Lab) -> None:
    lab.start()
    since_s = lab.in_motion()
    lab.router.kill()
    lost = lab.told("lost")
    print(f"lost after {lost['at_s'] - since_s:.2f} s: {lost['why']}")


def test_its_client_is_refused_and_then_stops_the_arm(lab: Lab) -> None:
    with Client(lab.endpoint, "fr3") as client:
        lab.start()
        lab.in_motion()
        told = client.ask(verb="acquire")
        assert told["said"].startswith("held by ")
        assert "not the holder" in client.ask(verb="drive")["said"]
        assert told["phase"] == "active"
        since_s = time.monotonic()
        told = client.ask(verb="stop")
        fault = lab.told("fault")
        assert "somebody asked it to stop" in fault["why"]
        print(f"its stop was told after {fault['at_s'] - since_s:.2f} s")
        print(f"arm stood after {lab.watch.stood(since_s)}")
        assert told["said"] == "ok"
