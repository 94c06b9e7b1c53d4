"""The commands of a canary against two robots on a bus: workers are real, arms and command nodes
are what a canary knows of them. `tests/wire/test_workers.py` has a switch of a real arm in motion.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint, until
from typer.testing import CliRunner

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile, as_robot, load_profile
from vla_zenoh.program.main import app
from vla_zenoh.types import GripperState, Header, NodeStatus, PoseState, Task

PROFILE = """\
extends: panda_sim
robot: {{name: one}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
"""
ROBOTS = ("one", "two")
STATE_HZ, RATE_HZ = 50.0, 10.0
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
APART_MM, ATOL_MM = 3.0, 0.01

pytestmark = pytest.mark.realtime


class Robot:
    """A command node that takes every worker, and an arm that rests.

    `falls`: its arm, active until then, is inactive once it obeys this worker.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        self.keys, self._session, self._seq = profile.keys, session, 0
        self.task = Task(1, False, "go", "good", RATE_HZ)
        self.falls = ""
        self._declared = [
            session.liveliness().declare_token(self.keys.alive("command")),
            session.declare_subscriber(
                self.keys.worker, zenoh.handlers.Callback(self._choose, indirect=False)
            ),
        ]

    def _choose(self, sample: zenoh.Sample) -> None:
        worker = sample.payload.to_string()
        active = self.task.active and worker != self.falls
        self.task = replace(self.task, worker=worker, episode=self.task.episode + 1, active=active)

    def say(self) -> None:
        self._seq += 1
        state = "active" if self.task.active else "inactive"
        detail = {"worker": self.task.worker, "accepted_chunks": 1, "why": "it fell"}
        status = NodeStatus("command", state, "h", 1, 2, detail=detail)
        pose = PoseState(np.array([0.4, 0.0, 0.3]), DOWN, np.zeros(6))
        for key, source, record in (
            (self.keys.task, "command#1", self.task),
            (self.keys.status("command"), "command#1", status),
            (self.keys.state_pose, "sim#1", pose),
            (self.keys.state_gripper, "sim#1", GripperState(0.08, False, False)),
        ):
            header = records.encode_header(Header(time.time_ns(), self._seq, source))
            self._session.put(key, records.encode(record), attachment=header)


class Riser:
    """Asks for one step up, for any number of robots."""

    def __init__(self, name: str, step_mm: float) -> None:
        self._step_m = step_mm / 1e3
        self.spec = ModelSpec(
            name=name,
            observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
            action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        return ActionSteps([[0.0, 0.0, self._step_m, 0.0, 0.0, 0.0]])

    def infer_batch(self, observations: Sequence[Observation]) -> list[ActionSteps]:
        return [self.infer(observation) for observation in observations]


class Lab:
    def __init__(self, folder: Path) -> None:
        self.file, self.figures = folder / "lab.yaml", folder / "f.json"
        self.file.write_text(PROFILE.format(endpoint=free_endpoint()))
        self.profile = load_profile(str(self.file))
        self.robots: dict[str, Robot] = {}

    def canary(self, *words: str, code: int = 0) -> Any:
        """The JSON of a command; of one that raises its error."""
        found = CliRunner().invoke(app, ["canary", *words, "--json", "--profile", str(self.file)])
        if isinstance(found.exception, VlaZenohError):
            assert code == 1
            return str(found.exception)
        assert found.exit_code == code, found.output
        return json.loads(found.stdout)

    def promote(self, *words: str, code: int = 0) -> Any:
        least = ("--min-seconds", "1", "--min-pairs", "5")
        return self.canary("promote", str(self.figures), *least, *words, code=code)

    def obeyed(self) -> list[str]:
        return [robot.task.worker for robot in self.robots.values()]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    found = Lab(tmp_path)
    profile, stop = found.profile, threading.Event()
    with ExitStack() as opened:
        opened.enter_context(open_session(profile.session, mode="router"))
        session = opened.enter_context(open_session(profile.session))
        found.robots = {name: Robot(as_robot(profile, name), session) for name in ROBOTS}
        nodes = [
            WorkerNode(profile, session, Riser(name, step_mm), name, robots=ROBOTS)
            for name, step_mm in (("good", 10.0), ("mine", 10.0 + APART_MM))
        ]

        def speak() -> None:
            while not stop.wait(1.0 / STATE_HZ):
                for robot in found.robots.values():
                    robot.say()

        threads = [threading.Thread(target=node.run, args=(stop,)) for node in nodes]
        threads.append(threading.Thread(target=speak))
        for thread in threads:
            thread.start()
        try:
            yield found
        finally:
            stop.set()
            for thread in threads:
                thread.join(10.0)


def test_a_worker_is_watched_promoted_on_all_robots_and_taken_back(lab: Lab) -> None:
    said = lab.canary("promote", str(lab.figures), code=1)
    assert "figures_missing" in said

    watch = ("watch", "mine", "--robots", "one,two", "-o", str(lab.figures), "--seconds", "3")
    figures = lab.canary(*watch)["robots"]
    for robot in ROBOTS:
        found = figures[robot]
        assert found["apart"]["pairs"] >= 5
        assert found["apart"]["distance_mm"] == pytest.approx([APART_MM] * 2, abs=ATOL_MM)
        assert found["new"]["chunks"] >= 5
        assert found["new"]["rejected"] == found["new"]["failed"] == {}
        assert (found["obeyed"], found["active_s"]) == ("good", 0.0)

    (first, *_) = lab.promote("--max-apart-mm", "1", code=3)["refused"]
    assert (first["robot"], first["name"]) == ("one", "apart")
    assert lab.obeyed() == ["good", "good"]

    assert [each["why"] for each in lab.promote("--robots", "two")["switched"]] == [""]
    assert lab.obeyed() == ["good", "mine"]
    assert {each["robot"] for each in lab.promote(code=3)["refused"]} == {"two"}
    lab.promote("--robots", "one")
    until("both obey it", lambda: lab.obeyed() == ["mine", "mine"])

    back = lab.canary("back", str(lab.figures))
    assert [(each["robot"], each["worker"]) for each in back["switched"]] == [
        ("two", "good"),
        ("one", "good"),
    ]
    assert lab.obeyed() == ["good", "good"]
    assert set(back["since"]["one"]["inference_ms"]) == {"mine", "good"}
    assert "not_promoted" in lab.canary("back", str(lab.figures), code=1)


def test_where_one_active_arm_does_not_follow_all_obey_their_worker_again(lab: Lab) -> None:
    one, two = lab.robots.values()
    for robot in (one, two):
        robot.task = replace(robot.task, active=True)
    lab.canary("watch", "mine", "-r", "one,two", "-o", str(lab.figures), "-s", "2")
    two.falls = "mine"
    found = lab.promote(code=1)["switched"]
    assert [(each["robot"], each["worker"], each["in_motion"]) for each in found] == [
        ("one", "mine", True),
        ("two", "mine", True),
        ("two", "good", False),
        ("one", "good", True),
    ]
    assert found[1]["why"] == "the arm does not follow it: it fell"
    assert lab.obeyed() == ["good", "good"]
    assert one.task.active
    assert "not_promoted" in lab.canary("back", str(lab.figures), code=1)


def test_a_worker_that_is_obeyed_or_not_there_cannot_be_watched(lab: Lab) -> None:
    assert "obeys 'good', so it is in no shadow" in lab.canary(
        "watch", "good", "-o", str(lab.figures), code=1
    )
    assert "worker 'mime' of robot one is not alive; did you mean 'mine'?" in lab.canary(
        "watch", "mime", "-o", str(lab.figures), code=1
    )
    assert not lab.figures.exists()
