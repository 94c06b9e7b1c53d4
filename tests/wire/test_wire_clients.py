"""Clients of the wire in plain Python, without our package, at work in the real chain."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from chain import LONG_PATIENCE_S, Chain, running_chain
from vla_zenoh_conform import rules
from wire_rig import (
    CLIENTS,
    alone,
    conform,
    in_python,
    moves_exactly_stops_and_is_reset,
    profile_of,
    running,
)

from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.lab.tasks.judge import judge_of
from vla_zenoh.lab.tasks.order import parse_prompt
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, ObjectPoses

PROMPT = "put the red brick in the box"
TASK_S = 40.0
CAMERA_HZ = 10


@pytest.mark.long
def test_operator_and_worker_in_plain_python_put_the_brick_in_the_box(tmp_path: Path) -> None:
    more = (
        "cameras: {front: null, wrist: null}\n"
        "workers: [plain]\n"
        "task: {prompt: hold, rate_hz: 10, worker: plain}\n"
        "hosts: {here: {nodes: [router, sim, command]}}\n"
    )
    path = profile_of(tmp_path, "panda_bricks", more)
    with (
        running_chain(tmp_path, profile_file=path) as chain,
        running(in_python(chain.profile, "worker.py")),
    ):
        keys = chain.profile.keys
        wanted = {ObjectPoses: keys.sim_objects, GripperState: keys.state_gripper}
        newest = NewestRecords(chain.session, wanted)
        chain.activate_when_ready()
        chain.client.deactivate()
        order = parse_prompt(PROMPT)
        assert order is not None
        judge = judge_of(order, newest.read(ObjectPoses)[1])
        operator = in_python(chain.profile, "operator_client.py", "plain", PROMPT, str(TASK_S))
        with running(operator):
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
    path = profile_of(tmp_path, str(CLIENTS / "robot.yaml"))
    with running_chain(tmp_path, profile_file=path) as chain:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        words = in_python(chain.profile, "robot.py", str(LONG_PATIENCE_S["command"]))
        with running(words):
            yield chain


def test_a_robot_in_plain_python_moves_exactly_stops_and_is_reset(plain_robot: Chain) -> None:
    moves_exactly_stops_and_is_reset(plain_robot)


WRONG_ROBOT = """
import robot
robot.OneWriter.check = lambda self, header: None
robot.Arm.stop = lambda self: None
robot.Arm.tick = lambda self: None
"""
"""The plain robot without its duties: it takes commands of all writers, and obeys no stop."""
OUR_ROBOT = [sys.executable, "-m", "vla_zenoh", "node", "sim"]


@pytest.mark.long
@pytest.mark.parametrize("which", ["ours", "plain", "wrong"])
def test_conform_tells_a_right_robot_from_a_wrong_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], which: str
) -> None:
    extends = "panda_sim" if which == "ours" else str(CLIENTS / "robot.yaml")
    path = profile_of(tmp_path, extends)
    profile = load_profile(str(path))
    words = in_python(profile, "robot.py", str(LONG_PATIENCE_S["command"]))
    if which == "ours":
        words = [*OUR_ROBOT, "--profile", str(path)]
    elif which == "wrong":
        words = in_python(profile, "robot.py", before=WRONG_ROBOT)
    with alone(path, *words):
        status, found, told = conform(capsys, path, profile.robot.node, "robot", "--move")
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


def test_conform_finds_nothing_wrong_with_the_worker_in_plain_python(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = (
        "cameras: {front: null, wrist: null}\n"
        "workers: [plain]\n"
        "task: {prompt: hold, rate_hz: 10, worker: plain}\n"
        "hosts: {here: {nodes: [router, sim, command]}}\n"
    )
    path = profile_of(tmp_path, "panda_bricks", more)
    words = in_python(load_profile(str(path)), "worker.py")
    with running_chain(tmp_path, profile_file=path), running(words):
        status, found, told = conform(capsys, path, "worker-plain", "worker", "plain")
    assert not {rule for rule, right in found.items() if right is False}, told
    assert {"steps as its spec says", "spec_hash", "episode", "times in order"} <= set(found), told
    assert status == 0


def test_an_arm_is_activated_with_the_images_of_a_camera_in_plain_python(tmp_path: Path) -> None:
    more = (
        f"cameras: {{front: {{rate_hz: {CAMERA_HZ}}}, wrist: null}}\n"
        "task: {prompt: hold, rate_hz: 5, worker: scripted}\n"
        "options: {scripted: {camera: front}}\n"
        "hosts: {here: {nodes: [router, sim, command, worker]}}\n"
    )
    path = profile_of(tmp_path, "panda_sim", more)
    words = in_python(load_profile(str(path)), "camera.py", "front", str(CAMERA_HZ))
    with running_chain(tmp_path, profile_file=path) as chain:
        with running(words):
            chain.activate_when_ready()
            chain.until("a chunk is accepted", lambda: chain.detail("accepted_steps"))
        chain.until("without the camera it is inactive", lambda: chain.state() == "inactive")
        assert "camera" in chain.detail("why")


FROZEN_CAMERA = """
import itertools, numpy
import camera
before, after = numpy.zeros((480, 640, 3), numpy.uint8), numpy.ones((480, 640, 3), numpy.uint8)
camera.images = lambda device: itertools.chain([before] * 50, itertools.repeat(after))
"""
"""The plain camera, whose image changes once."""


@pytest.mark.parametrize("which", ["plain", "frozen"])
def test_conform_tells_a_right_camera_from_a_frozen_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], which: str
) -> None:
    more = f"cameras: {{front: {{rate_hz: {CAMERA_HZ}}}, wrist: null}}\n"
    path = profile_of(tmp_path, "panda_sim", more)
    before = FROZEN_CAMERA if which == "frozen" else ""
    profile = load_profile(str(path))
    words = in_python(profile, "camera.py", "front", str(CAMERA_HZ), before=before)
    with alone(path, *words):
        status, found, told = conform(capsys, path, "camera", "camera", "front")
    wrong = {rule for rule, right in found.items() if right is False}
    streams = {f"camera/front/{kind}: images change" for kind in ("raw", "jpeg")}
    assert wrong == (streams if which == "frozen" else set()), told
    assert status == (1 if wrong else 0)
