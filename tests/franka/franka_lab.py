"""The whole chain with an FR3 of franka-sim in place of our simulator."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, Chain, running_chain
from franka_rig import Simulator, simulator

from vla_zenoh.codec import records
from vla_zenoh.kinematics.so3 import held_pose, pose_distance, pose_of
from vla_zenoh.types import GripperState

REACHED_M, REACHED_RAD = 1e-3, 2e-3
SETTLE_S, AGAIN_S = 3.0, 30.0
PROFILE = """
extends: fr3
franka: {{address: 127.0.0.1, realtime: ignore{franka}}}
robot: {{command: {command}}}
limits: {{workspace: {{z_m: [0.012, 0.95]}}}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: {patience_s[command]}, state_timeout_s: {patience_s[state]}}}
"""


@dataclass
class Lab:
    """The chain, and the simulator that it drives."""

    chain: Chain
    robot: Simulator
    widths_m: list[float] = field(default_factory=list)
    """Openings of the hand, as they came."""

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
        """The smallest distance within `SETTLE_S`: friction is integrated away."""
        end_s, found = time.monotonic() + SETTLE_S, (np.inf, np.inf)
        while time.monotonic() < end_s:
            state = self.chain.measured()
            found = min(found, pose_distance(pose_of(state), held_pose(state)))
            time.sleep(0.05)
        return found

    def fault(self) -> str:
        return self.chain.detail("fault", "arm") or ""

    def go_on(self) -> None:
        """What a person does: reset until the robot is well, and activate."""
        chain = self.chain

        def cleared() -> bool:
            if chain.state() in ("fault", "stopped"):
                chain.client.publish(chain.client.keys.reset, "")
                time.sleep(0.3)
            return chain.state() == "inactive" and not self.fault()

        chain.until("the fault is cleared", cleared, AGAIN_S)
        chain.activate_when_ready()


@contextmanager
def running_lab(
    folder: Path, command: str, *, options: Sequence[str] = (), hand: bool = False
) -> Iterator[Lab]:
    """A lab whose arm takes poses or joints.

    Args:
        folder: for the profile.
        command: ``pose`` or ``joint``.
        options: of the worker ``scripted``.
        hand: the arm has a Franka Hand.
    """
    profile = folder / "lab.yaml"
    profile.write_text(
        PROFILE.format(
            endpoint=free_endpoint(),
            command=command,
            franka="" if hand else ", hand: false",
            patience_s=CHAIN_PATIENCE_S,
        )
    )
    with (
        simulator(*(() if hand else ("--no-gripper",))) as robot,
        running_chain(
            folder, profile_file=profile, worker_options={"scripted": list(options)}
        ) as chain,
    ):
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        lab = Lab(chain, robot)

        def keep(sample: zenoh.Sample) -> None:
            state = records.decode(GripperState, sample.payload.to_bytes())
            lab.widths_m.append(state.width_m)

        subscribed = chain.session.declare_subscriber(
            chain.profile.keys.state_gripper, zenoh.handlers.Callback(keep, indirect=False)
        )
        yield lab
        subscribed.undeclare()
