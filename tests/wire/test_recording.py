"""A robot's keys into a file and back onto keys, with real nodes and processes."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import until
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain
from recording_rig import assert_same, ghost_of, recording
from rosbags.rosbag2 import Reader
from typed import typed
from vla_zenoh_replay.replay import CAMERAS, Replay

from vla_zenoh.bus.node import Publisher
from vla_zenoh.codec import records
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import Keys, Kind
from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run, pictures
from vla_zenoh.types import Event, NodeStatus

ROBOT_PATIENCE_S = LONG_PATIENCE_S
STEPS, STEP_M = 5, 0.01
REACHED_M = 0.002
FILE_LIMIT_BYTES = 400_000
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def recordings() -> dict[int, Path]:
    """By attempt: what a busy computer has spoiled is not asked again."""
    return {}


@pytest.fixture
def run_file(
    request: pytest.FixtureRequest,
    recordings: dict[int, Path],
    shared_chain: Chain,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A robot that goes up, recorded from before its activation until after it."""
    attempt = getattr(request.node, "execution_count", 1)
    if attempt not in recordings:
        path = tmp_path_factory.mktemp("recording") / "up.mcap"
        record_going_up(shared_chain, path)
        recordings[attempt] = path
    return recordings[attempt]


def record_going_up(chain: Chain, path: Path) -> None:
    chain.settle()
    with recording(chain, path):
        chain.client.set_prompt(f"HARD: go up x{STEPS}")
        chain.activate_when_ready()
        chain.until("the steps are done", lambda: bool(chain.detail("policy_done")), PATIENCE_S)
        chain.wait_still()
        chain.client.deactivate()
        chain.client.set_prompt("hold")


def test_the_file_holds_everything_that_was_said(run_file: Path, shared_chain: Chain) -> None:
    run = load_run(run_file)
    assert run.problems == []
    assert run.file.ended == {"dropped": {}, "lost": {}}
    streams = (run.poses, run.joints, run.grippers, run.commands, run.chunks, run.tasks)
    assert all(len(stream) > 5 for stream in (*streams, run.seen))
    assert run.picture_counts["front"] > 5
    said = [
        (run.keys.short(entry.key), entry.text)
        for entry in run.file.entries()
        if entry.header is None and entry.kind is None
    ]
    assert said[0] == ("prompt", "hold"), "the setting in force before the recording began"
    for setting in (("prompt", f"HARD: go up x{STEPS}"), ("active", "true"), ("active", "false")):
        assert setting in said
    assert {"camera", "command", "sim", "worker-scripted"} <= run.statuses.keys()
    assert any(heard.record.kind == "transition" for heard in run.events)
    (spec,) = run.specs.values()
    assert spec.name == "scripted"
    assert shared_chain.profile.session.connect[0] in run.file.profile_yaml


def test_every_sample_is_there_once_and_in_order(run_file: Path) -> None:
    last_ns = 0
    seqs: dict[tuple[str, str], int] = {}
    for entry in open_recording(run_file).entries():
        assert entry.received_ns >= last_ns
        last_ns = entry.received_ns
        if entry.header is not None and "state" in entry.key:
            source = (entry.key, entry.header.source)
            assert entry.header.seq == seqs.get(source, entry.header.seq - 1) + 1
            seqs[source] = entry.header.seq
    assert len(seqs) == 3


def test_rosbags_finds_the_standard_messages(run_file: Path) -> None:
    with Reader(run_file) as bag:
        types = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections}
    expected = {
        "/vla/panda/camera/front/jpeg": "sensor_msgs/msg/CompressedImage",
        "/vla/panda/state/joint": "sensor_msgs/msg/JointState",
        "/vla/panda/state/pose": "geometry_msgs/msg/PoseStamped",
        "/vla/panda/command/pose": "geometry_msgs/msg/PoseStamped",
        "/vla/panda/prompt": "std_msgs/msg/String",
    }
    for topic, name in expected.items():
        assert types[topic][0] == name
        assert types[topic][1] > 0


def test_its_evaluation_tells_what_the_arm_did(run_file: Path) -> None:
    found = evaluate_loaded(load_run(run_file), pictures=3)
    segment = next(s for s in found.segments if s.prompt == f"HARD: go up x{STEPS}")
    assert segment.asked_m == pytest.approx(STEPS * STEP_M)
    assert segment.along_m == pytest.approx(STEPS * STEP_M, abs=REACHED_M)
    assert found.command_path_m == pytest.approx(STEPS * STEP_M, abs=REACHED_M)
    assert found.requests >= STEPS
    # A chunk that comes just before the arm is deactivated leads to no command any more.
    assert found.executed_share is not None
    assert found.executed_share >= 1.0 - 1.0 / found.requests
    assert set(found.latency()) == {
        "end_to_end",
        "outbound",
        "inference",
        "inbound",
        "worker_to_command",
        "command_to_pose",
    }
    whole, parts = found.stages_ms["end_to_end"], ("outbound", "inference", "inbound")
    np.testing.assert_allclose(whole, sum(found.stages_ms[p] for p in parts), atol=1.0)
    assert found.problems == []
    seen = [view for view in found.views if view.model]
    assert len(found.views) == 3 + len(seen)


# -- replay ---------------------------------------------------------------------------------------
def moved_equally(one: Run, other: Run, kind: str) -> None:
    """Every record of the one is in the other, later by one and the same time."""
    a, b = getattr(one, kind), getattr(other, kind)
    assert [entry.header.seq for entry in a] == [entry.header.seq for entry in b]
    shifts = {y.header.stamp_wall_ns - x.header.stamp_wall_ns for x, y in zip(a, b, strict=True)}
    assert len(shifts) == 1


def test_a_replayed_run_evaluates_as_the_original(
    run_file: Path, chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ghost, again = ghost_of(chain), tmp_path / "again.mcap"
    with recording(chain, again, ghost):
        profile = str(chain.profile_file)
        words = ("replay", str(run_file), "--robot", "ghost", "--json", "--profile", profile)
        done = typed(capsys, *words)
        assert done.code == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["failure"] == ""
    assert set(result["interval_error_ms"]) == {"p50", "p95", "max"}
    one, other = load_run(run_file), load_run(again)
    assert other.keys == Keys("ghost")
    for kind in ("poses", "joints", "grippers", "commands", "chunks", "tasks", "seen"):
        moved_equally(one, other, kind)
    jpegs = [[p.jpeg for p in pictures(run.file, "front")] for run in (one, other)]
    assert jpegs[0] == jpegs[1]
    assert_same(evaluate_loaded(load_run(run_file)), evaluate_loaded(load_run(again)))


def test_a_worker_infers_on_a_replayed_run(run_file: Path, chain: Chain, tmp_path: Path) -> None:
    profile = tmp_path / "ghost.yaml"
    profile.write_text(f"extends: {chain.profile_file}\nrobot: {{name: ghost}}\n")
    statuses: list[NodeStatus] = []
    subscriber = chain.session.declare_subscriber(
        Keys("ghost").status("worker-scripted"),
        lambda s: statuses.append(records.decode(NodeStatus, s.payload.to_bytes())),
    )
    only = [word for part in ("cameras", "state", "task") for word in ("--only", part)]
    words = ("replay", str(run_file), "--robot", "ghost", "--loop", *only)
    with process("worker", "scripted", profile=profile), process(*words, profile=profile):
        until(
            "the worker infers",
            lambda: any(status.state == "inferring" for status in statuses),
            READY_PATIENCE_S,
        )
    subscriber.undeclare()


@contextmanager
def process(*words: str, profile: Path, **more: Any) -> Iterator[subprocess.Popen[str]]:
    child = subprocess.Popen(
        [sys.executable, "-m", "vla_zenoh", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "VLA_ZENOH_PROFILE": str(profile), "NO_COLOR": "1", "COLUMNS": "200"},
        **more,
    )
    try:
        yield child
    finally:
        child.terminate()
        try:
            child.communicate(timeout=15)
        finally:
            child.kill()


def test_a_replay_onto_a_live_robot_is_refused(run_file: Path, chain: Chain) -> None:
    with pytest.raises(NodeError, match=r"robot 'panda' is alive \(command, sim\).*--robot NAME"):
        Replay(chain.profile, chain.session, open_recording(run_file))


def test_pictures_beside_a_live_camera_are_left_out(run_file: Path, chain: Chain) -> None:
    file = open_recording(run_file)
    replayed = Replay(chain.profile, chain.session, file, groups={CAMERAS}).run(threading.Event())
    assert replayed.left_out.keys() == {"camera"}
    assert (replayed.samples.total(), replayed.failure) == (
        0,
        "nothing to publish",
    )


def test_a_replay_ends_when_a_robot_comes_to_life(run_file: Path, chain: Chain) -> None:
    ghost = ghost_of(chain, "sleeper")
    replay = Replay(ghost, chain.session, open_recording(run_file), loop=True)
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(replay.run(threading.Event())))
    thread.start()
    time.sleep(1.0)
    token = chain.session.liveliness().declare_token(ghost.keys.alive("command"))
    thread.join(PATIENCE_S)
    token.undeclare()
    assert "robot 'sleeper' is alive (command)" in found[0].failure


def test_a_recorder_of_any_name_keeps_no_replay_from_its_robot(
    run_file: Path, chain: Chain
) -> None:
    ghost = ghost_of(chain, "heard")
    token = chain.session.liveliness().declare_token(ghost.keys.alive("evening"))
    Replay(ghost, chain.session, open_recording(run_file))
    token.undeclare()


def test_only_pictures_may_be_replayed_beside_a_live_robot(run_file: Path, chain: Chain) -> None:
    ghost = ghost_of(chain, "blind")
    token = chain.session.liveliness().declare_token(ghost.keys.alive("command"))
    file = open_recording(run_file)
    with pytest.raises(NodeError, match=r"robot 'blind' is alive \(command\)"):
        Replay(ghost, chain.session, file, groups={CAMERAS, "state"})
    replayed = Replay(ghost, chain.session, file, groups={CAMERAS}, speed=8).run(threading.Event())
    token.undeclare()
    assert set(replayed.samples) == {Keys("blind").camera_jpeg("front")}
    assert replayed.failure == ""


# -- what goes wrong ------------------------------------------------------------------------------
def test_what_the_queue_cannot_take_is_counted_and_said(chain: Chain, tmp_path: Path) -> None:
    ghost, path = ghost_of(chain, "fast"), tmp_path / "a.mcap"
    recorder = Recorder(ghost, chain.session, path, queue_bytes=200).start()
    key = ghost.keys.event("camera")
    stream = Publisher(chain.session, key, Kind.ORDER, "camera#1", recorder.node.clock)
    small = Event("info", "notice", "x")
    for event in (small, Event("info", "notice", "x", "y" * 400), small):
        stream.publish(event)
        time.sleep(0.4)
    recorded = recorder.close()
    # What it says of itself is larger than this queue, and is missing as well.
    assert recorded.dropped[key] == 1
    run = load_run(path)
    assert run.file.ended == {"dropped": dict(recorded.dropped), "lost": {}}
    assert [len(heard.record.why) for heard in run.events if "camera" in heard.key] == [0, 0]
    assert (
        f"the recorder dropped {recorded.dropped.total()} samples"
        in evaluate_loaded(load_run(path)).problems
    )


@pytest.mark.slow
def test_a_recorder_that_is_killed_leaves_a_readable_file(chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "a.part.mcap"
    words = ("record", "--output", str(tmp_path / "a.mcap"))
    with process(*words, profile=chain.profile_file) as child:
        until(
            "something is recorded",
            lambda: path.exists() and path.stat().st_size > 50_000,
            READY_PATIENCE_S,
        )
        child.send_signal(signal.SIGKILL)
        child.wait(10)
    run = load_run(path)
    assert run.file.damage == ""
    assert len(run.poses) > 10
    with Reader(path) as bag:
        assert sum(1 for _ in bag.messages()) > len(run.poses)
    assert evaluate_loaded(load_run(path)).problems == [
        "its recorder was ended before it could finish the file"
    ]


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_spares_the_file(chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_LIMIT_BYTES, FILE_LIMIT_BYTES))

    with process(
        "record", "--output", str(path), profile=chain.profile_file, preexec_fn=limit
    ) as child:
        output, _ = child.communicate(timeout=60)
    assert child.returncode == 1
    assert "File too large; what was recorded until then is whole" in " ".join(output.split())
    assert not path.exists()
    run = load_run(tmp_path / "a.part.mcap")
    assert run.file.damage == ""
    assert len(run.poses) > 10


def test_the_recorder_says_how_it_goes(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    done = typed(
        capsys,
        "record",
        "--output",
        str(path),
        "--seconds",
        "1",
        "--keys",
        "state/*",
        "--keys",
        "status/recorder",
        "--json",
        "--profile",
        str(chain.profile_file),
    )
    assert done.code == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    assert (result["dropped"], result["failure"]) == ({}, "")
    assert result["size_bytes"] == path.stat().st_size
    status = load_run(path).statuses["recorder"]
    assert status.state == "recording"
    assert status.counters["dropped"] == 0
    assert set(result["samples"]) == {
        *(chain.profile.keys.full(f"state/{part}") for part in ("joint", "pose", "gripper")),
        chain.profile.keys.status("recorder"),
    }
