"""A tiny OpenVLA through everything: camera, worker in its own environment, command node, arm."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from chain import Chain, command_line, running_chain

from vla_zenoh.keys import worker_node
from vla_zenoh.policy.loader import find_model
from vla_zenoh.runtime.environments import environment_command

pytestmark = [pytest.mark.models, pytest.mark.timeout(300)]

NODE = worker_node("openvla")
START_S = 120.0
"""An environment that is there already, torch and weights, on a busy machine."""
MOVED_M = 0.02
"""Far more than an arm that stands is seen to move."""
CHUNKS = 10
STAGES = {"vision", "projector", "prefill and first token", "decode", "action", "generate"}
OPTIONS = ("unnorm_key=bridge_orig", "device=cpu")
MAKER = Path(__file__).parent / "openvla" / "tiny_openvla.py"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights") / "tiny"
    command = environment_command(find_model("openvla"))
    subprocess.run([*command, "python", str(MAKER), str(folder)], check=True, timeout=START_S)
    return folder


@pytest.fixture(scope="module")
def robot(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with running_chain(
        tmp_path_factory.mktemp("chain"),
        rate_hz=2.0,
        more="workers: [scripted, openvla]\n",
        worker_options={"openvla": [f"checkpoint={checkpoint}", *OPTIONS]},
    ) as chain:
        yield chain


def test_the_arm_goes_where_openvla_says(robot: Chain) -> None:
    robot.until("OpenVLA infers", lambda: robot.state(NODE) == "inferring", START_S)
    robot.client.set_worker("openvla")
    robot.client.set_prompt("put the red brick in the box")
    start_m = robot.measured().position_m
    robot.activate_when_ready(START_S)
    robot.until("steps are carried out", lambda: robot.detail("accepted_steps") >= CHUNKS, START_S)
    assert robot.state() == "active"
    moved_m = np.linalg.norm(robot.measured().position_m - start_m)
    assert moved_m > MOVED_M
    status = robot.client.status(NODE)
    assert status is not None
    assert min(status.latency_ms["inference"]) > 0
    assert not {k: n for k, n in robot.refused().items() if n and k.startswith(NODE)}
    robot.client.deactivate(10.0)


def test_it_keeps_its_contract(checkpoint: Path) -> None:
    options = [f"--set=checkpoint={checkpoint}", *(f"--set={option}" for option in OPTIONS)]
    done = command_line(
        "check", "openvla", *options, "--profile=panda_sim", "--json", timeout_s=START_S
    )
    report = json.loads(done.stdout)
    assert report["ok"], report["findings"]
    assert report["depends_on"]["pictures"]
    assert report["depends_on"]["prompt"]


def test_the_stages_of_an_action_are_measured(checkpoint: Path, tmp_path: Path) -> None:
    file = tmp_path / "stages.json"
    options = [f"--set=checkpoint={checkpoint}", *(f"--set={option}" for option in OPTIONS)]
    words = ["-m", "benchmarks", "openvla", *options, "--rounds", "3", "--output", str(file)]
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, timeout=START_S
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(file.read_text())
    assert {stage["name"] for stage in report["stages"]} > STAGES
    assert report["same_tokens"]
    assert report["memory_mb"]["llama"] > report["memory_mb"]["vision"] > 0


def test_weights_that_are_not_there_end_the_worker_with_a_reason(tmp_path: Path) -> None:
    done = command_line(
        "worker", "openvla", f"--set=checkpoint={tmp_path / 'nowhere'}", timeout_s=START_S
    )
    assert done.returncode != 0
    assert "is not a folder" in done.stderr.replace("\n", " ")
