"""Clients of the wire in plain Python, without our package, at work in the real chain."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain, command_line, running_chain
from vla_zenoh_conform import rules

from vla_zenoh.bus.session import alive_nodes, open_session
from vla_zenoh.errors import SessionError
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.lab.tasks.judge import judge_of
from vla_zenoh.lab.tasks.order import parse_prompt
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import GripperState, ObjectPoses

CLIENTS = Path(__file__).parents[2] / "examples" / "wire"
ALONE = "import sys; sys.modules['vla_zenoh'] = None"
"""Runs before each client: importing our package is an error there."""
PROMPT = "put the red brick in the box"
TASK_S = 40.0
UP_STEPS, UP_M, EXACT_M = 10, 0.1, 1e-3
PROFILE = """\
extends: {extends}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing: {{command_timeout_s: {command}, state_timeout_s: {state}}}
{more}"""


def profile_of(folder: Path, extends: str, more: str) -> Path:
    path = folder / "wire.yaml"
    endpoint = free_endpoint()
    path.write_text(
        PROFILE.format(extends=extends, endpoint=endpoint, more=more, **LONG_PATIENCE_S)
    )
    return path


def program(profile: Profile, name: str, *arguments: str, before: str = "") -> list[str]:
    """Words that start a client; `before` runs first."""
    (endpoint,) = profile.session.connect
    robot = f"{profile.root}/{profile.robot.name}"
    lines = [
        ALONE,
        f"sys.path.insert(0, {str(CLIENTS)!r})",
        before,
        f"import {name.removesuffix('.py')} as client",
        f"client.main({', '.join(map(repr, (endpoint, robot, *arguments)))})",
    ]
    return [sys.executable, "-u", "-c", "\n".join(lines)]


@contextmanager
def client(chain: Chain, name: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    words = program(chain.profile, name, *arguments)
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def test_operator_and_worker_in_plain_python_put_the_brick_in_the_box(tmp_path: Path) -> None:
    more = (
        "cameras: {front: null, wrist: null}\n"
        "workers: [plain]\n"
        "task: {prompt: hold, rate_hz: 10, worker: plain}\n"
        "hosts: {here: {nodes: [router, sim, command]}}\n"
    )
    path = profile_of(tmp_path, "panda_bricks", more)
    with running_chain(tmp_path, profile_file=path) as chain, client(chain, "worker.py"):
        keys = chain.profile.keys
        wanted = {ObjectPoses: keys.sim_objects, GripperState: keys.state_gripper}
        newest = NewestRecords(chain.session, wanted)
        chain.activate_when_ready()
        chain.client.deactivate()
        order = parse_prompt(PROMPT)
        assert order is not None
        judge = judge_of(order, newest.read(ObjectPoses)[1])
        with client(chain, "operator_client.py", "plain", PROMPT, str(TASK_S)):
            verdict, began_s = None, time.monotonic()
            while verdict is None and time.monotonic() - began_s < TASK_S:
                time.sleep(0.05)
                objects = newest.read(ObjectPoses)[1]
                width_m = newest.read(GripperState)[1].width_m
                verdict = judge.update(objects, width_m, time.monotonic() - began_s)
            assert verdict is not None, chain.story()
            assert verdict.success, verdict
        # The operator is gone, and with it its deadman's token.
        chain.until("it is inactive", lambda: chain.state() == "inactive")


@pytest.fixture
def plain_robot(tmp_path: Path) -> Iterator[Chain]:
    path = profile_of(tmp_path, str(CLIENTS / "robot.yaml"), "")
    with running_chain(tmp_path, profile_file=path) as chain:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        with client(chain, "robot.py", str(LONG_PATIENCE_S["command"])):
            yield chain


def test_a_robot_in_plain_python_moves_exactly_stops_and_is_reset(plain_robot: Chain) -> None:
    chain = plain_robot
    chain.activate_when_ready()
    chain.client.set_prompt("hold")
    chain.wait_still()
    before_m = chain.height_m()
    prompt = f"HARD: go up x{UP_STEPS}"
    chain.client.set_prompt(prompt)
    chain.until(
        "it is up", lambda: chain.detail("policy_done") and chain.detail("prompt") == prompt
    )
    chain.wait_still()
    assert chain.height_m() - before_m == pytest.approx(UP_M, abs=EXACT_M)
    chain.client.set_prompt("HARD: go down")
    chain.until("it moves", chain.moves)
    chain.client.stop()
    chain.until("it is stopped", lambda: chain.state() == "stopped")
    chain.until("the robot says so", lambda: chain.state("arm") == "latched")
    chain.client.reset()
    chain.until(
        "it is reset", lambda: chain.state() == "inactive" and chain.state("arm") == "running"
    )
    chain.activate_when_ready()


WRONG_ROBOT = """
import robot
robot.OneWriter.check = lambda self, header: None
robot.Arm.stop = lambda self: None
robot.Arm.tick = lambda self: None
"""
"""The plain robot without its duties: it takes commands of all writers, and obeys no stop."""
OUR_ROBOT = [sys.executable, "-m", "vla_zenoh", "node", "sim"]


@contextmanager
def alone(profile_file: Path, *words: str) -> Iterator[None]:
    """A router and a robot, and nothing else."""
    router = [sys.executable, "-m", "vla_zenoh", "node", "router", "--profile", str(profile_file)]
    with subprocess.Popen(router, stdout=subprocess.DEVNULL) as first:
        try:
            until("the router listens", lambda: _listens(profile_file), READY_PATIENCE_S)
            with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
                try:
                    yield
                finally:
                    process.terminate()
        finally:
            first.terminate()


def _listens(profile_file: Path) -> bool:
    try:
        open_session(load_profile(str(profile_file)).session).close()
    except SessionError:
        return False
    return True


def conform(profile_file: Path, node: str) -> tuple[int, dict[str, bool | None], str]:
    def there() -> bool:
        profile = load_profile(str(profile_file))
        with open_session(profile.session) as session:
            return node in alive_nodes(session, profile.keys, node)

    until("the robot is there", there, READY_PATIENCE_S)
    words = ("conform", "robot", "--move", "--json", "--profile", str(profile_file))
    done = command_line(*words)
    assert done.stdout, done.stderr
    found = {each["rule"]: each["right"] for each in json.loads(done.stdout)}
    return done.returncode, found, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.parametrize("which", ["ours", "plain", "wrong"])
def test_conform_tells_a_right_robot_from_a_wrong_one(tmp_path: Path, which: str) -> None:
    extends = "panda_sim" if which == "ours" else str(CLIENTS / "robot.yaml")
    path = profile_of(tmp_path, extends, "")
    profile = load_profile(str(path))
    words = program(profile, "robot.py", str(LONG_PATIENCE_S["command"]))
    if which == "ours":
        words = [*OUR_ROBOT, "--profile", str(path)]
    elif which == "wrong":
        words = program(profile, "robot.py", before=WRONG_ROBOT)
    with alone(path, *words):
        status, found, told = conform(path, profile.robot.node)
    wrong = {rule for rule, right in found.items() if right is False}
    assert set(rules.TRIALS) <= set(found), told
    if which == "wrong":
        assert wrong >= {rules.REPLAYED, rules.FOREIGN, rules.STALE, rules.STOP, rules.LATCHED}, (
            told
        )
        assert status == 1
    else:
        assert not wrong, told
        assert status == 0
