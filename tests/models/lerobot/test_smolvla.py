"""A tiny SmolVLA with LeRobot's real-time chunking holds a brick in the simulated SO-101."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import tiny_smolvla
from brick_rig import IN_JAW_M, held, hold
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.world import build_world

pytestmark = [pytest.mark.models, pytest.mark.timeout(1800)]

SO101 = load_profile("so101_sim")
SHUT, DEVIATION_PERCENT, DEVIATION_DEG = 5.0, 1.0, 0.5
"""Number of the gripper, of 0 to 100, and how far one unit of the network's answers goes."""


class Watched:
    """A policy, and what it is asked and answers."""

    takes_committed = True

    def __init__(self, policy: Any) -> None:
        self.policy, self.spec = policy, policy.spec
        self.committed: list[Committed] = []
        self.answers: list[ActionSteps] = []

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        if committed is not None:
            self.committed.append(committed)
        self.answers.append(self.policy.infer(observation, committed=committed))
        return self.answers[-1]


def test_a_tiny_smolvla_with_real_time_chunking_holds_a_brick_for_a_minute(tmp_path: Path) -> None:
    home_deg = np.rad2deg(SO101.robot.home_rad)
    tiny_smolvla.write(
        tmp_path / "smolvla",
        mean=[*home_deg, SHUT],
        std=[*[DEVIATION_DEG] * len(home_deg), DEVIATION_PERCENT],
    )
    options = {
        "checkpoint": str(tmp_path / "smolvla"),
        "device": "cpu",
        "profile": "so101_sim",
        "rtc": "on",
        "state": "joint_deg+gripper_open",
        "action": "joint_position",
        "joint_scale_rad": str(np.pi / 180),
        "gripper": "open_fraction",
        "gripper_range": "0:100",
        "dt_s": "0.0333333",
    }
    policy = make_policy(find_model("lerobot"), options)
    policy.load()
    watched, world = Watched(policy), build_world(SO101)
    was_m = hold(world, IN_JAW_M, SO101)
    late = Delays(inference_s=0.15, camera_s=0.02)
    loop = Lockstep(SO101, world, watched, delays=late, reach=ReachabilityFilter(SO101))
    loop.put("rate", 5.0)
    loop.put("prompt", "hold the brick")
    loop.run(0.5)
    assert loop.activate(2.0, 0.1) == ""
    loop.run(60.0)
    held(world, was_m)
    assert loop.commander.task.active
    assert len(watched.committed) > 250
    asked_percent = 100.0 * np.concatenate([answer.steps[:, -1] for answer in watched.answers])
    assert np.abs(asked_percent - SHUT).max() < 5.0 * DEVIATION_PERCENT
