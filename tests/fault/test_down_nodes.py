"""Nodes that cannot run say why: in `up`, `status` and `activate`; and a host runs once."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from camera_rig import until
from chain import READY_PATIENCE_S, command_line, write_profile
from test_supervisor import Up, client_of, up

from vla_zenoh.client.client import Client
from vla_zenoh.runtime.supervisor import GIVE_UP_AFTER

pytestmark = pytest.mark.long

GIVE_UP_S = 120.0
REASON = "FileNotFoundError: weights.pt not found"
DEVICE = "/dev/video97"
NOISE = ("nanobind", "leaked", ".rs:", "cargo")
MODEL = """\
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec


class Model:
    spec = ModelSpec(
        name="bad",
        observation=ObservationSpec(),
        action=ActionSpec(horizon=1, dt_s=0.2, rotation="rpy", gripper="none"),
    )

    def load(self):
        raise FileNotFoundError("weights.pt not found")

    def infer(self, observation):
        return ActionSteps([[0.0] * 6])
"""


class Lab(NamedTuple):
    """A running `up`: worker `bad` cannot load its weights, camera `wrist` is not plugged in."""

    profile: Path
    running: Up
    client: Client
    log: Path

    def run(self, *words: str) -> Any:
        return command_line(*words, profile=self.profile)

    def status(self) -> Any:
        return json.loads(self.run("status", "--json").stdout)


def lab_profile(folder: Path) -> Path:
    (folder / "bad.py").write_text(MODEL)
    more = "workers: [scripted, bad]\nmodels: {bad: ./bad.py}\n"
    more += "options: {scripted: {camera: wrist}}\n"
    path = write_profile(folder, more=more)
    path.write_text(path.read_text().replace("wrist: null", f"wrist: {{source: 'v4l2:{DEVICE}'}}"))
    return path


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    path = lab_profile(folder)
    running = Up(str(path), "--log-dir", str(folder / "log"))
    try:
        with client_of(path) as (client, _):
            until("the robot", lambda: {"sim", "command"} <= client.alive, READY_PATIENCE_S)
            yield Lab(path, running, client, folder / "log" / "panda-here.log")
    finally:
        running.end(signal.SIGTERM)
        running.thread.join(5.0)
        assert running.process.stdout is not None
        running.process.stdout.close()


def test_a_second_up_says_who_runs_and_starts_nothing(lab: Lab) -> None:
    done = command_line("up", str(lab.profile))
    assert done.returncode == 1
    pid = lab.running.process.pid
    assert f"host here of robot panda is already running: pid {pid}" in done.stderr
    assert "started" not in done.stdout
    assert lab.running.process.poll() is None


def test_a_worker_whose_load_raises_is_one_line_and_its_reason_is_everywhere(lab: Lab) -> None:
    def given_up() -> bool:
        return f"crashed {GIVE_UP_AFTER} times in a row; not restarting" in lab.running.text

    until("it is given up", given_up, GIVE_UP_S)
    ours = [line for line in lab.running.lines if "worker-bad |" in line]
    ours = [line for line in ours if " zenoh::" not in line]  # of a query that comes as it ends
    assert len([line for line in ours if "exited with code 1" in line]) == 1
    assert all(REASON in line for line in ours if "started" not in line)
    assert "Traceback" not in lab.running.text
    log = lab.log.read_text()
    assert "Traceback" in log
    assert 'raise FileNotFoundError("weights.pt not found")' in log

    events = [event for node, _, event in list(lab.client.events) if node == "worker-bad"]
    assert any(event.what == "crashed" and REASON in event.why for event in events)

    told = lab.status()
    bad = told["nodes"]["worker-bad"]
    assert (bad["state"], bad["alive"]) == ("crashed", False)
    why = f"crashed {GIVE_UP_AFTER} times: {REASON}; correct that and restart `up` there"
    assert bad["why"] == why
    assert why in lab.run("status", "--once").stdout

    assert f"worker 'bad' is not alive: {why}. Alive are: scripted" in lab.run("use", "bad").stderr
    lab.client.publish(lab.client.keys.worker, "bad")
    refused = lab.run("activate")
    assert refused.returncode == 1
    assert f"worker 'bad' is not alive: {why}" in refused.stderr
    assert lab.run("use", "scripted").returncode == 0


def test_status_has_a_row_for_a_node_that_is_not_there(lab: Lab) -> None:
    until("the camera node", lambda: "camera" in lab.client.alive, READY_PATIENCE_S)
    os.kill(lab.running.process.pid, signal.SIGSTOP)  # so that it starts nothing again
    try:
        pid = lab.status()["nodes"]["camera"]["pid"]
        os.kill(pid, signal.SIGKILL)
        until("it is gone", lambda: "camera" not in lab.client.alive)
        camera = lab.status()["nodes"]["camera"]
        assert (camera["state"], camera["alive"]) == ("missing", False)
        assert "`vla-zenoh up` on host here" in camera["why"]
    finally:
        os.kill(lab.running.process.pid, signal.SIGCONT)
    until("it is back", lambda: "camera" in lab.client.alive, READY_PATIENCE_S)


def test_a_camera_that_is_not_plugged_in_is_named_in_status_and_by_activate(lab: Lab) -> None:
    why = f"there is no {DEVICE}; cameras here: "
    until("the camera node", lambda: "camera" in lab.client.alive, READY_PATIENCE_S)
    assert lab.status()["nodes"]["camera"]["state"] == "degraded"
    (row,) = (line for line in lab.run("status", "--once").stdout.splitlines() if why in line)
    assert row.split()[:2] == ["camera", "degraded"]
    assert f"camera 'wrist': {why}" in row

    refused = lab.run("activate")
    assert refused.returncode == 1
    assert f"camera 'wrist' has sent no image yet: {why}" in refused.stderr


def test_sim_stands_in_front_of_what_moves(lab: Lab) -> None:
    assert lab.status()["mode"] == "sim"
    assert "SIM |" in lab.running.text
    shown = lab.run("status", "--once").stdout
    assert "SIM robot panda: a simulated robot moves" in shown
    assert shown.count("a simulated robot moves") == 1
    assert "SIM inactive" in shown


def test_a_clean_end_is_silent(tmp_path: Path) -> None:
    path = lab_profile(tmp_path)
    with up(str(path)) as running:
        with client_of(path) as (client, _):
            until("the robot", lambda: {"sim", "command"} <= client.alive, READY_PATIENCE_S)
        running.end(signal.SIGTERM)
        running.thread.join(5.0)
        assert "all nodes have stopped" in running.text
        assert [line for line in running.lines if any(word in line for word in NOISE)] == []
