"""Inspect Robots 0.60 itself: its eval, doctor and LLM agent, with our simulated arm."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from camera_rig import free_endpoint
from chain import LONG_PATIENCE_S, Chain, running_chain
from r2c_rig import Process

VARIABLE = "INSPECT_PYTHON"
SCRIPT = Path(__file__).with_name("inspect_arm_process.py")
TURNED_RAD, EXACT_RAD = 0.2, 2e-3
REACTION_S, STARTS_S = 1.5, 90.0
# An arm that takes poses brings its TCP there, and keeps its own elbow.
PROFILE = """
extends: panda_sim
robot: {{command: joint}}
cameras: {{front: null, wrist: null}}
options: {{scripted: {{camera: ""}}}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing:
  command_hz: 100
  state_hz: 100
  command_timeout_s: {patience_s[command]}
  state_timeout_s: {patience_s[state]}
hosts: {{here: {{nodes: [router, sim, command, worker]}}}}
"""

pytestmark = pytest.mark.timeout(170)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("inspect")
    path = folder / "arm.yaml"
    path.write_text(PROFILE.format(endpoint=free_endpoint(), patience_s=LONG_PATIENCE_S))
    with running_chain(folder, profile_file=path) as found:
        found.activate_when_ready()
        found.settle()
        yield found
        found.settle()


@pytest.fixture(autouse=True)
def settled(chain: Chain) -> Iterator[None]:
    yield
    chain.settle()


def words(chain: Chain, verb: str, folder: Path) -> list[str]:
    return [os.environ[VARIABLE], str(SCRIPT), str(chain.profile_file), verb, str(folder)]


def result(chain: Chain, verb: str, folder: Path) -> Any:
    done = subprocess.run(
        words(chain, verb, folder), capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_their_eval_moves_it_exactly(chain: Chain, tmp_path: Path) -> None:
    found = result(chain, "turn", tmp_path)
    print(f"at rest {found['off_rad']:.1e} rad off")
    assert found["status"] == "success", found
    assert found["off_rad"] < EXACT_RAD
    assert found["turned_rad"] == pytest.approx(TURNED_RAD, abs=2 * EXACT_RAD)
    assert chain.state() == "inactive"


def test_a_target_that_is_refused_moves_nothing_and_the_trial_goes_on(
    chain: Chain, tmp_path: Path
) -> None:
    found = result(chain, "aside", tmp_path)
    assert found["status"] == "success"
    assert len(found["refused"]) == 1
    assert "joint_limit" in found["refused"][0]
    assert found["off_rad"] < EXACT_RAD


def test_their_agent_is_told_why_and_corrects_itself(chain: Chain, tmp_path: Path) -> None:
    found = result(chain, "agent", tmp_path)
    assert found["status"] == "success"
    assert found["heard"][0].startswith("pre-check rejected this motion: waypoint")
    assert "rejected" not in found["heard"][1]


def test_a_stop_in_motion_halts_their_eval_with_the_reason(chain: Chain, tmp_path: Path) -> None:
    with Process(tmp_path / "eval.log", words(chain, "endless", tmp_path)) as process:
        process.until("READY", STARTS_S)
        chain.until("it is active", lambda: chain.state() == "active", 40)
        chain.until("it moves", chain.moves)
        chain.client.stop()
        process.until('"status": "error"')
        assert "stop" in process.text


def test_their_eval_killed_in_motion_brakes_the_arm(chain: Chain, tmp_path: Path) -> None:
    with Process(tmp_path / "eval.log", words(chain, "endless", tmp_path)) as process:
        process.until("READY", STARTS_S)
        chain.until("it is active", lambda: chain.state() == "active", 40)
        chain.until("it moves", chain.moves)
        began_s = time.monotonic()
        process.kill()
        chain.until("it stands", lambda: chain.state() == "inactive" and chain.detail("at_rest"))
        took_s = time.monotonic() - began_s
        print(f"kill -9 of their eval: stood after {took_s:.2f} s")
        assert took_s < REACTION_S


def test_a_router_killed_halts_their_eval(chain: Chain, tmp_path: Path) -> None:
    with Process(tmp_path / "eval.log", words(chain, "endless", tmp_path)) as process:
        process.until("READY", STARTS_S)
        chain.until("it is active", lambda: chain.state() == "active", 40)
        chain.until("it moves", chain.moves)
        before = chain.pid("router")
        os.kill(before, signal.SIGKILL)
        process.until('"status": "error"')
        chain.until(
            "it stands", lambda: chain.state() == "inactive" and chain.detail("at_rest"), 20
        )


def test_a_second_commander_takes_it_only_by_name(chain: Chain, tmp_path: Path) -> None:
    with Process(tmp_path / "eval.log", words(chain, "endless", tmp_path)) as process:
        process.until("READY", STARTS_S)
        chain.until("it is active", lambda: chain.state() == "active", 40)
        chain.client.set_worker("scripted")
        process.until('"status": "error"')
        assert "follows worker" in process.text or "not active" in process.text
