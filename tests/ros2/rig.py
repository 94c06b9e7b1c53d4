"""A whole ROS 2 lab on one computer: DDS robot, real bridge, our nodes, and a witness in DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bridge import Bridge, generated
from camera_rig import free_endpoint
from chain import READY_PATIENCE_S, Chain, running_chain
from ros_node import free_domain
from witness import FloatArray, Witness

ROBOT = Path(__file__).with_name("panda_robot.py")
ROBOT_READY_S = 30.0
STEP_M, MIDDLE_M, MOVING_M_S = 0.01, 0.45, 0.05
WIDTH, HEIGHT, CAMERA_HZ, STATE_HZ = 80, 60, 20, 100
COMMAND_HZ = 100
ON_TIME, PICTURE_AGE_MS = 0.85, 50.0

PROFILE = """\
extends: panda_ros2
cameras:
  # Drawn, without noise: a still scene gives the very same picture.
  front: {{width: {width}, height: {height}, rate_hz: {camera_hz}, check: {{same_s: 0}}}}
  wrist: null
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session:
  listen: ["{endpoint}"]
  connect: ["{endpoint}"]
ros2:
  domain: {domain}
  services: true
  cameras: {{wrist: null}}
"""
# Robot, bridge, witness and our nodes keep two cores busy with that.
TIMING = f"""\
timing:
  command_hz: {COMMAND_HZ}
  state_hz: {STATE_HZ}
"""
PATIENT = """\
  command_timeout_s: 0.25
  state_timeout_s: 0.35
  watchdog_s: 1.0
"""
"""For tests that measure no brake: a busy computer makes the arm brake again and again."""
APART = """\
  connect: ["{endpoint}"]
"""
Topology = Literal["beside", "router", "apart"]


class Robot:
    """The DDS robot as a process.

    Args:
        domain: ROS domain id.
        arguments: further ones of its command line.
    """

    def __init__(self, domain: int, *arguments: str) -> None:
        words = [sys.executable, str(ROBOT), "--domain", str(domain), *arguments]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self._said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        give_up = time.monotonic() + ROBOT_READY_S
        while "ready" not in self._said:
            if self._process.poll() is not None or time.monotonic() > give_up:
                self.end()
                raise AssertionError("the DDS robot does not start; see what it wrote above")
            time.sleep(0.01)

    def _read(self) -> None:
        assert self._process.stdout is not None
        self._said.extend(line.strip() for line in self._process.stdout)

    def freeze(self) -> None:
        """It hangs: it neither says anything nor leaves."""
        os.kill(self._process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        os.kill(self._process.pid, signal.SIGCONT)

    def switch_controller(self) -> None:
        """Off, or on again."""
        os.kill(self._process.pid, signal.SIGUSR1)

    def end(self) -> None:
        if self._process.poll() is None:
            self.thaw()
            self._process.terminate()
        self._process.wait(10)
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()


@dataclass
class Lab:
    """What a test holds."""

    domain: int
    robot: Robot
    bridge: Bridge
    witness: Witness
    chain: Chain

    def settle(self) -> None:
        """Whatever was before: inactive, standing, prompt ``hold``."""
        self.chain.settle()
        self.witness.wait_still()
        self.witness.forget()
        self.chain.recorder.forget()
        self.chain.client.pop_events()
        assert not self.chain.failure, self.chain.failure

    def activate_at_rest(self) -> FloatArray:
        """Activate with prompt ``hold``; returns where the arm then stands."""
        self.chain.client.set_prompt("hold")
        self.chain.activate_when_ready()
        return self.witness.wait_still()

    def go_down_to(self, height_m: float) -> None:
        """Bring the arm to this height or below, and leave it inactive."""
        steps = round((self.witness.position_m()[2] - height_m) / STEP_M)
        if steps > 0:
            self.activate_at_rest()
            self.chain.client.set_rate(15.0)
            self.chain.go("down", steps, timeout_s=30.0)
        self.settle()

    def move(self) -> None:
        """Activate with an endless motion away from the nearer end; returns when it is fast."""
        up = self.witness.position_m()[2] < MIDDLE_M
        self.chain.client.set_rate(10.0)
        self.chain.client.set_prompt("HARD: go up" if up else "HARD: go down")
        self.chain.activate_when_ready()
        self.chain.until("it moves", self._moves)

    def _moves(self) -> bool:
        if self.chain.state() == "inactive":  # a busy computer was late with a state
            self.chain.activate_when_ready()
        return self.witness.speed_m_s() > MOVING_M_S

    def when(self, what: str, since_ns: int) -> float:
        """Seconds from `since_ns` to the first event of this name."""
        found = [
            header.stamp_wall_ns
            for _, header, event in list(self.chain.client.events)
            if event.what == what and header.stamp_wall_ns > since_ns
        ]
        assert found, f"no event {what}\n{self.story()}"
        return (found[0] - since_ns) / 1e9

    def story(self) -> str:
        """For the message of a test that fails."""
        return f"{self.chain.story()}\nbridge:\n{self.bridge.tail()}"


@contextmanager
def running_lab(
    folder: Path,
    program: Path,
    *,
    topology: Topology = "beside",
    state_hz: int = STATE_HZ,
    watch_goals: bool = True,
    timing: str = "",
) -> Iterator[Lab]:
    """Everything up while the block lasts.

    Args:
        folder: for profile, settings and logs.
        program: the bridge.
        topology: ``beside``: the bridge is a client of our router, as our nodes are; ``router``:
            our nodes are clients of the bridge, which is a router when it is started as it comes;
            ``apart``: it is one, but only the node ``ros2`` speaks to it, and we have our own.
        state_hz: rate of the robot's joint states.
        watch_goals: the witness listens to what the robot is told, too.
        timing: more YAML of this section.
    """
    domain, ours = free_domain(), free_endpoint()
    theirs = free_endpoint() if topology == "apart" else ours
    profile = folder / "ros2_lab.yaml"
    sizes = {"width": WIDTH, "height": HEIGHT, "camera_hz": CAMERA_HZ}
    text = PROFILE.format(**sizes, endpoint=ours, domain=domain)
    if topology == "apart":
        text += APART.format(endpoint=theirs)
    profile.write_text(text + TIMING + timing)
    pictures = ("--width", WIDTH, "--height", HEIGHT, "--camera-hz", CAMERA_HZ)
    with ExitStack() as stack:
        settings = generated(profile, beside=topology == "beside")
        bridge = Bridge(program, folder, settings).start()
        stack.callback(bridge.kill)
        robot = Robot(domain, "--camera", "front", "--state-hz", str(state_hz), *map(str, pictures))
        stack.callback(robot.end)
        witness = Witness(domain, watch_goals=watch_goals)
        stack.callback(witness.close)
        chain = stack.enter_context(running_chain(folder, profile_file=profile))
        chain.recorder.only = {"state": "ros2#", "command": "command#"}
        # Pictures queue up in the bridge while the nodes start, and chunks with them.
        chain.until("pictures come in time", lambda: pictures_in_time(chain), READY_PATIENCE_S)
        yield Lab(domain, robot, bridge, witness, chain)


def pictures_in_time(chain: Chain) -> bool:
    """The node `ros2` gets nearly all pictures of the camera, soon after they were taken."""
    status = chain.client.status("ros2")
    if status is None or status.rates_hz.get("front", 0.0) < ON_TIME * CAMERA_HZ:
        return False
    return status.latency_ms["front"][0] < PICTURE_AGE_MS
