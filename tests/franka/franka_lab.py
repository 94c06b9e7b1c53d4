"""The whole chain with an FR3 of franka-sim in place of our simulator."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, Chain, running_chain
from franka_rig import PORT, Cable, Simulator, cable, simulator

from vla_zenoh.codec import records
from vla_zenoh.kinematics.so3 import held_pose, pose_distance, pose_of
from vla_zenoh.types import GripperState

REACHED_M, REACHED_RAD = 1e-3, 2e-3
FAR, FAR_PORT = "127.0.0.2", 14370
"""Address of an arm behind a cable, and where its simulator listens."""
SETTLE_S, LOOK_S, AGAIN_S = 2.5, 0.5, 30.0
COMMAND_HZ = 250 if (os.cpu_count() or 1) >= 4 else 125
"""At 250 Hz simulator, arm node and command node take more than two cores while the arm moves."""
PROFILE = """
extends: fr3
franka: {{address: {address}, realtime: ignore{franka}}}
robot: {{command: {command}}}
limits:
  workspace: {{z_m: [0.012, 0.95]}}
  contact: {{effort_slow_nm: null, effort_stop_nm: null}} # franka-sim reports zeros
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing:
  command_hz: {command_hz}
  command_timeout_s: {patience_s[command]}
  state_timeout_s: {patience_s[state]}
"""


@dataclass
class Lab:
    """The chain, and the simulator that it drives."""

    chain: Chain
    robot: Simulator
    cable: Cable | None = None
    hand: list[GripperState] = field(default_factory=list)
    """States of the hand, as they came."""

    def share(self, since: int) -> str:
        """The figures to read beside a result."""
        rate = self.chain.detail("control_command_success_rate", "arm")
        return (
            f"simulator at {self.robot.realtime_share(since):.2f} of real time, "
            f"control_command_success_rate {rate}, load {os.getloadavg()[0]:.1f}"
        )

    def way(self, prompt: str, steps: int) -> tuple[float, float]:
        """Carry out a prompt; how far set-point and measured TCP are apart at its end."""
        chain = self.chain
        chain.client.set_prompt("hold")
        chain.wait_still()
        chain.client.set_prompt(f"HARD: {prompt} x{steps}")
        chain.until(
            f"{steps} steps are carried out",
            lambda: chain.detail("policy_done") and chain.detail("accepted_steps") >= steps,
            40.0,
        )
        chain.wait_still()
        return self.apart()

    def apart(self) -> tuple[float, float]:
        """The largest distance in `LOOK_S`, after friction had `SETTLE_S` to be trimmed away."""
        time.sleep(SETTLE_S)
        end_s, found = time.monotonic() + LOOK_S, np.zeros(2)
        while time.monotonic() < end_s:
            state = self.chain.measured()
            found = np.maximum(found, pose_distance(pose_of(state), held_pose(state)))
            time.sleep(0.02)
        return float(found[0]), float(found[1])

    def hand_at(self, width_m: float, exact_m: float) -> bool:
        """The fingers are there."""
        return abs(self.hand[-1].width_m - width_m) < exact_m

    def fault(self) -> str:
        return self.chain.detail("fault", "arm") or ""

    def go_on(self) -> None:
        """What a person does: one `vla-zenoh reset`, as soon as the arm is there, and activate."""
        chain = self.chain
        there = ("running", "fault", "latched")
        chain.until("the arm is there", lambda: chain.state("arm") in there, AGAIN_S)
        if chain.state() in ("fault", "stopped"):
            chain.client.reset()
            chain.until("the reset is enough", chain.client.cleared, AGAIN_S)
        assert not self.fault()
        chain.activate_when_ready()


@contextmanager
def running_lab(
    folder: Path,
    command: str,
    *,
    options: Sequence[str] = (),
    hand: bool = False,
    robot_options: Sequence[str] = (),
    with_cable: bool = False,
    more: str = "",
) -> Iterator[Lab]:
    """A lab whose arm takes poses or joints.

    Args:
        folder: for the profile.
        command: ``pose`` or ``joint``.
        options: of the worker ``scripted``.
        hand: the arm has a Franka Hand.
        robot_options: of the simulator.
        with_cable: the arm is reached by `Lab.cable`, which can be pulled.
        more: YAML at the end of the profile.
    """
    profile = folder / "lab.yaml"
    profile.write_text(
        PROFILE.format(
            address=FAR if with_cable else "127.0.0.1",
            endpoint=free_endpoint(),
            command=command,
            command_hz=COMMAND_HZ,
            franka="" if hand else ", hand: false",
            patience_s=CHAIN_PATIENCE_S,
        )
        + more
    )
    given = (*(() if hand else ("--no-gripper",)), *robot_options)
    with ExitStack() as stack:
        port = FAR_PORT if with_cable else PORT
        robot = stack.enter_context(simulator(*given, port=port))
        way = stack.enter_context(cable(FAR, port)) if with_cable else None
        worker_options = {"scripted": list(options)}
        chain = stack.enter_context(
            running_chain(folder, profile_file=profile, worker_options=worker_options)
        )
        chain.until(
            "the chain is up",
            lambda: chain.client.task is not None and chain.state() not in ("", "starting"),
            AGAIN_S,
        )
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        lab = Lab(chain, robot, way)

        def keep(sample: zenoh.Sample) -> None:
            lab.hand.append(records.decode(GripperState, sample.payload.to_bytes()))

        subscribed = chain.session.declare_subscriber(
            chain.profile.keys.state_gripper, zenoh.handlers.Callback(keep, indirect=False)
        )
        yield lab
        subscribed.undeclare()
