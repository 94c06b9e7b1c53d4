"""Three builds of the wire on two hosts: robot and command node, and models and people.

As it is, with one more optional field in every record, and with a raised version; all pairs, each
way: a worker reads tasks and states, the command node specs and chunks.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from camera_rig import until
from netns.lab import Lab, lab, needs_namespaces, scratch

pytestmark = [pytest.mark.netns, pytest.mark.slow, needs_namespaces, pytest.mark.timeout(600)]

HERE = Path(__file__).parent
VLA = (sys.executable, "-m", "vla_zenoh")
BUILDS = ("now", "more", "raised")
STEPS, STEP_M, TOLERANCE_M = 3, 0.01, 0.001
READY_S, TRIED_S, NOT_CONFIRMED = 90.0, 200.0, 4
PROFILE = """\
extends: panda_sim
cameras: {{front: null, wrist: null}}
workers: [now, more, raised]
models: {{now: scripted, more: scripted, raised: scripted}}
options: {{now: {{camera: ""}}, more: {{camera: ""}}, raised: {{camera: ""}}}}
task: {{prompt: hold, rate_hz: 10, worker: now}}
timing: {{command_timeout_s: 1.0, state_timeout_s: 2.0}}
session:
  listen: ["tcp/{address}:7447"]
  connect: ["tcp/{address}:7447"]
  lease_ms: 4000
  insecure: true # the namespaces are all there is on this network
hosts:
  robot: {{nodes: [router, sim, command]}}
  gpu: {{nodes: [worker]}}
"""


class Running(NamedTuple):
    """Two hosts, the robot's with one build, the other with a worker of each."""

    build: str
    hosts: Lab
    profile: Path

    def person(self, build: str, *words: str) -> tuple[int, str]:
        """Exit status and words of a command of a build on the other host."""
        host = self.hosts["gpu"]
        host.environment["WIRE_BUILD"] = build
        done = host.run(*VLA, *words, "--profile", str(self.profile))
        return done.returncode, " ".join(f"{done.stdout}{done.stderr}".split())


def schema_of(build: str) -> int:
    return 3 if build == "raised" else 2


def words_of(writer: str, reader: str) -> str:
    """What the reader says of the writer's records; empty: they have the same version."""
    theirs, ours = schema_of(writer), schema_of(reader)
    if theirs == ours:
        return ""
    who = "this side" if theirs > ours else "the sender"
    return f"schema {theirs} of the wire, this program has {ours}: update vla-zenoh on {who}"


@pytest.fixture(scope="module", params=BUILDS)
def running(request: pytest.FixtureRequest) -> Iterator[Running]:
    with scratch() as folder, lab("robot", "gpu") as hosts:
        profile, log = folder / "builds.yaml", folder / "robot.log"
        profile.write_text(PROFILE.format(address=hosts["robot"].address))
        for host in hosts.hosts.values():
            host.python_folders.append(str(HERE / "builds"))
        hosts["robot"].environment["WIRE_BUILD"] = request.param
        up = (*VLA, "up", str(profile), "--host", "robot", "--no-record")
        hosts["robot"].start(*up, output=log)
        until("the robot's host is ready", lambda: "ready" in log.read_text(), READY_S)
        for build in BUILDS:
            hosts["gpu"].environment["WIRE_BUILD"] = build
            words = (*VLA, "worker", build, "--profile", str(profile))
            hosts["gpu"].start(*words, output=folder / f"{build}.log")
        yield Running(request.param, hosts, profile)


def test_a_worker_of_the_same_version_moves_the_arm_and_another_is_named(running: Running) -> None:
    words = (str(running.profile), str(STEPS))
    program = HERE / "try_workers.py"
    found: dict[str, Any] = running.hosts["robot"].ask(program, *words, timeout_s=TRIED_S)
    events = [event for each in found["workers"].values() for event in each["events"]]
    for worker, each in found["workers"].items():
        why = words_of(worker, running.build)
        if not why:
            assert each["why"] == "", json.dumps(found)
            assert each["way_m"] == pytest.approx(STEPS * STEP_M, abs=TOLERANCE_M)
            continue
        assert f"worker {worker!r} has not published its spec" in each["why"]
        assert each["way_m"] == 0.0
        assert f"command: schema: spec/{worker}: {why}" in events
    # A field that is unknown is counted, and nothing is rejected for it.
    unknown = running.build == "now" and found["counters"].get("unknown_fields", 0)
    assert bool(unknown) == (running.build == "now"), found["counters"]
    assert found["counters"].get("refused.schema", 0) > 0


@pytest.mark.parametrize("build", BUILDS)
def test_a_person_with_another_version_is_told_which_side_to_update(
    running: Running, build: str
) -> None:
    why = words_of(running.build, build)
    _, told = running.person(build, "status")
    assert why in told
    status, told = running.person(build, "prompt", "hold")
    assert (status == 0) == (why == ""), told
    assert why in told
    # A stop is plain text, which every version obeys; one that reads no states cannot confirm it.
    status, told = running.person(build, "stop")
    assert status == (NOT_CONFIRMED if why else 0), told
    status, told = running.person(running.build, "status")
    assert "stopped" in told
    assert running.person(running.build, "reset")[0] == 0
