"""A tiny policy of LeRobot's through everything: camera, own environment, command node, arm."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from chain import Chain, command_line, running_chain

from vla_zenoh.keys import worker_node
from vla_zenoh.policy.loader import find_model
from vla_zenoh.runtime.environments import environment_command

pytestmark = [pytest.mark.models, pytest.mark.timeout(300)]

NODE = worker_node("lerobot")
START_S = 120.0
"""An environment that is there already, torch and weights, on a busy machine."""
MOVED_M = 0.02
"""Far more than an arm that stands is seen to move."""
STEPS = 20
OPTIONS = (
    "device=cpu",
    "action=delta",
    "anchor=goal",
    "relative_to=previous",
    "controller=none",
    "rotation=rpy",
    "gripper=open_fraction",
    "gripper_open=high",
    "dt_s=0.1",
    "state=position+rpy+gripper_m",
    "resize=stretch",
)
MAKER = Path(__file__).parent / "lerobot" / "tiny_act.py"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights") / "act"
    command = environment_command(find_model("lerobot"))
    subprocess.run([*command, "python", str(MAKER), str(folder)], check=True, timeout=START_S)
    return folder


@pytest.fixture(scope="module")
def robot(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with running_chain(
        tmp_path_factory.mktemp("chain"),
        rate_hz=2.0,
        more="workers: [scripted, lerobot]\n",
        worker_options={"lerobot": [f"checkpoint={checkpoint}", *OPTIONS]},
    ) as chain:
        yield chain


def test_the_arm_goes_where_the_policy_says(robot: Chain) -> None:
    robot.until("it infers", lambda: robot.state(NODE) == "inferring", START_S)
    robot.client.set_worker("lerobot")
    start_m = robot.measured().position_m
    robot.activate_when_ready(START_S)
    robot.until("steps are carried out", lambda: robot.detail("accepted_steps") >= STEPS, START_S)
    assert robot.state() == "active"
    assert np.linalg.norm(robot.measured().position_m - start_m) > MOVED_M
    assert not {k: n for k, n in robot.refused().items() if n and k.startswith(NODE)}
    robot.client.deactivate(10.0)


def test_it_keeps_its_contract(checkpoint: Path) -> None:
    options = [f"--set=checkpoint={checkpoint}", *(f"--set={option}" for option in OPTIONS)]
    done = command_line(
        "check", "lerobot", *options, "--profile=panda_sim", "--json", timeout_s=START_S
    )
    report = json.loads(done.stdout)
    assert report["ok"], report["findings"]
    assert report["depends_on"].get("pictures"), report
