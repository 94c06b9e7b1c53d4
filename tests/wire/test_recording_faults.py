"""Recorders and replays that cannot begin, or cannot go on: they end, and others may start."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from camera_rig import free_endpoint, until
from vla_zenoh_replay.replay import Replay, ReplayResult
from vla_zenoh_web.recordings import Recordings

from vla_zenoh import keys
from vla_zenoh.bus.session import alive_nodes, open_session
from vla_zenoh.codec import records
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.sample import TEXT, Sample
from vla_zenoh.lab.recording.writer import CrashSafeFile, RecordingWriter
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import Header

pytestmark = pytest.mark.long

BEGAN_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
PATIENCE_S = 10.0
QUIET_S = 1.5
"""A pass of the recording begins after half a second and takes another."""


@pytest.fixture
def profile() -> Profile:
    endpoint = free_endpoint()
    place = {"connect": [endpoint], "listen": [endpoint]}
    return override(load_profile("panda_sim"), {"session": place})


@pytest.fixture
def session(profile: Profile) -> Iterator[zenoh.Session]:
    with open_session(profile.session, mode="router"), open_session(profile.session) as session:
        yield session


def run_of(profile: Profile, path: Path, *stamps_ns: int | None) -> Path:
    """A recording of activations, one every `STEP_NS`; those with a stamp have a header."""
    writer = RecordingWriter(
        path, profile.keys, profile_yaml="", base_frame="base", began_ns=BEGAN_NS
    )
    for at, stamp_ns in enumerate(stamps_ns):
        header = None if stamp_ns is None else Header(stamp_ns, at, "person#1")
        received_ns = BEGAN_NS + at * STEP_NS
        writer.write(Sample(profile.keys.active, b"true", TEXT, header, received_ns))
    writer.finish()
    return path


def begun(replay: Replay) -> tuple[threading.Thread, list[ReplayResult]]:
    found: list[ReplayResult] = []
    thread = threading.Thread(target=lambda: found.append(replay.run(threading.Event())))
    thread.daemon = True
    thread.start()
    return thread, found


def await_gone(session: zenoh.Session, profile: Profile) -> None:
    """The router may announce a node for a moment after its end."""
    until("no node is alive", lambda: not alive_nodes(session, profile.keys))


def test_a_replay_that_lost_its_link_sends_nothing_to_a_robot_that_came_meanwhile(
    profile: Profile, tmp_path: Path
) -> None:
    file = open_recording(run_of(profile, tmp_path / "run.mcap", *[None] * 50))
    router = open_session(profile.session, mode="router")
    with open_session(profile.session) as session:
        replay = Replay(profile, session, file, loop=True)
        thread, found = begun(replay)
        until("it sends", lambda: replay.replayed.samples.total() > 5)
        router.close()
        heard: list[Any] = []
        with (
            open_session(profile.session, mode="router", wait_s=PATIENCE_S),
            open_session(profile.session, wait_s=PATIENCE_S) as robot,
            robot.declare_subscriber(
                profile.keys.active, zenoh.handlers.Callback(heard.append, indirect=False)
            ),
        ):
            until("it is linked again", session.info.routers_zid)
            thread.join(QUIET_S)
            assert not thread.is_alive()
            assert heard == []
            assert "the link to the router was lost" in found[0].failure
            await_gone(robot, profile)


def test_a_sample_that_cannot_be_moved_to_now_ends_the_replay(
    profile: Profile, session: zenoh.Session, tmp_path: Path
) -> None:
    path = run_of(profile, tmp_path / "run.mcap", BEGAN_NS, 2**63 - 1, BEGAN_NS)
    replay = Replay(profile, session, open_recording(path), loop=True)
    thread, found = begun(replay)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert f"{path} cannot be replayed: stamp_wall_ns" in found[0].failure
    assert replay.replayed.samples.total() == 1
    await_gone(session, profile)


def test_after_a_full_disk_the_page_records_again(
    profile: Profile, session: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise RecordingError("disk full")

    page = Recordings(profile, session, tmp_path)
    monkeypatch.setattr(CrashSafeFile, "commit", full)
    with pytest.raises(RecordingError, match="disk full"):
        page.begin()
    monkeypatch.undo()
    await_gone(session, profile)
    page.begin()
    assert page.described()["on"]
    page.close()


def test_a_recorder_that_cannot_subscribe_leaves_the_bus_and_closes_its_file(
    profile: Profile, session: zenoh.Session, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(RecordingError, match="not a key expression"):
        Recorder(profile, session, path, expressions=[profile.keys.active, "a//b"]).start()
    await_gone(session, profile)
    file = open_recording(path)
    list(file.entries())
    assert file.ended == {"dropped": {}, "lost": {}}


def test_whatever_ends_the_writing_ends_the_recording_with_its_reason(
    profile: Profile, session: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> None:
        raise KeyError("a fault that nobody thought of")

    recorder = Recorder(profile, session, tmp_path / "run.mcap")
    monkeypatch.setattr(RecordingWriter, "commit", broken)
    recorded = recorder.run(threading.Event(), PATIENCE_S)
    assert "a fault that nobody thought of" in recorded.failure
    assert recorded.seconds < PATIENCE_S
    await_gone(session, profile)


def test_samples_of_another_version_of_the_wire_are_counted_with_what_to_update(
    profile: Profile, session: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(keys, "SCHEMA", keys.SCHEMA + 1)
        newer = records.encode_header(Header(1, 2, "sim#1"))
    recorder = Recorder(profile, session, tmp_path / "run.mcap").start()

    def counted() -> bool:
        session.put(profile.keys.state_pose, b"", attachment=newer)
        session.put(f"{profile.keys.state_pose}/theirs", b"", attachment=newer)
        session.put(profile.keys.prompt, b"go", attachment=b"of somebody else")
        return recorder.recorded.unreadable > 2

    until("some are counted", counted)
    recorded = recorder.close()
    assert recorded.samples[profile.keys.state_pose] == recorded.unreadable
    assert "update vla-zenoh on this side" in recorded.unreadable_why
