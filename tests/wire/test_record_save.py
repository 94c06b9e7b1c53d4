"""The rolling record beside a real chain: what it keeps, when it saves, and who asked for what."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from chain import Chain
from typed import Typed, typed
from vla_zenoh_rolling import cli, node
from vla_zenoh_rolling.node import RingLimits, RollingRecord
from vla_zenoh_rolling.ring import PART
from vla_zenoh_rolling.settings_log import LOG, entries_of

from vla_zenoh.bus import clock
from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import Kind, open_session
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import ROLLING
from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.types import Event

SHORT = RingLimits(keep_s=4.0, max_bytes=40 * 1024**2, segment_s=1.0, after_s=0.5)
LOGGED_S = 30.0
"""From a put to its line, on a busy machine."""
SOON_S = 0.5
"""Instead of seconds: what is told from time to time, tried again, or waited for in vain."""
STEP_S = 7.0
FLOOD = 8_000


class Kept:
    """A rolling record that runs, and its folder."""

    def __init__(self, chain: Chain, folder: Path) -> None:
        self.chain, self.folder = chain, folder

    def entries(self, what: str) -> list[dict[str, Any]]:
        every = {"at", "wall_ns", "what"}
        return [
            {name: value for name, value in each.items() if name not in every}
            for each in entries_of(self.folder)
            if each["what"] == what
        ]

    def saved(self) -> list[Path]:
        """Whole ones: a folder has another name until everything is in it."""
        return sorted(each for each in (self.folder / "saved").glob("*") if each.suffix != PART)

    def until(self, what: str, condition: Callable[[], Any]) -> Any:
        return self.chain.until(what, condition, LOGGED_S)


@pytest.fixture(autouse=True)
def _in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread is not the last one here that a busy computer runs: the tests wait for it."""
    monkeypatch.setattr(node, "NICE", 0)


def by_hand(capsys: pytest.CaptureFixture[str], chain: Chain, *words: str) -> Typed:
    return typed(capsys, *words, "--profile", str(chain.profile_file))


@contextmanager
def kept(chain: Chain, folder: Path, limits: RingLimits = SHORT) -> Iterator[Kept]:
    stop = threading.Event()
    with open_session(chain.profile.session) as session:
        record = RollingRecord(chain.profile, session, folder, limits)
        thread = threading.Thread(target=record.run, args=(stop,), name=ROLLING)
        thread.start()
        try:
            chain.until("it records", lambda: _detail(chain).get("folder") == str(folder))
            yield Kept(chain, folder)
        finally:
            stop.set()
            thread.join()


def test_a_stop_is_saved_with_what_came_before_and_after_it_and_evaluates(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chain.activate_when_ready()  # a rejected activation would be saved, too
    with kept(chain, tmp_path) as record:
        chain.move()
        chain.client.stop()
        record.until("it is saved", record.saved)
        (folder,) = record.saved()
        assert folder.name.endswith("-stop")
    run = load_run(folder)
    assert run.problems == []
    assert {"active", "stopped"} <= {command.record.state for command in run.commands} | {
        event.record.what.rpartition("->")[2] for event in run.events
    }
    assert run.picture_counts["front"] > 0
    assert not any("raw" in key for key in (entry.key for entry in run.file.entries()))
    done = typed(capsys, "eval", str(folder), "--json")
    assert done.code == 0, done.stderr
    assert "stop" in [each.get("key") for each in entries_of(folder)], "the log is saved, too"


def test_the_log_says_which_session_put_what_and_what_came_of_it(
    chain: Chain, tmp_path: Path
) -> None:
    with kept(chain, tmp_path) as record:
        author = str(chain.session.zid())
        chain.client.set_prompt("HARD: go up")
        chain.session.put(chain.profile.keys.rate, "5")
        chain.until("the rate is set", lambda: chain.client.task.rate_hz == 5.0)
        chain.activate_when_ready()
        assert chain.client.deactivate()
        record.until(
            "it is logged",
            lambda: any(each["event"] == "active->inactive" for each in record.entries("command")),
        )
        puts = record.entries("put")
        by = {each["key"]: each["client"] for each in puts}
        assert (by["prompt"], by["active"]) == (author, author)
        assert by["rate"] == "", "a client of another program does not say who it is"

        def told_of() -> list[dict[str, Any]]:
            return [each for each in record.entries("client") if each["client"] == author]

        record.until("its address is known", told_of)
        (told,) = told_of()
        assert told["certificate"] == "", "this lab has none"
        assert told["address"].startswith("tcp/127.0.0.1:")
        events = [each["event"] for each in record.entries("command")]
        assert events[-2:] == ["inactive->active", "active->inactive"]
        lines = (tmp_path / LOG).read_text().splitlines()
        asked = f'"key": "prompt", "text": "HARD: go up", "client": "{author}"'
        assert [line for line in lines if asked in line], "a person can read it"


def test_a_rejected_activation_is_saved_once_a_minute_at_most(chain: Chain, tmp_path: Path) -> None:
    with kept(chain, tmp_path) as record:
        chain.client.set_worker("nobody")
        for _ in range(3):
            with pytest.raises(SessionError):
                chain.client.activate()
        record.until("it is saved", record.saved)
        time.sleep(2 * SHORT.after_s)
        (folder,) = record.saved()
        assert folder.name.endswith("-activation-refused")
        refused = [e for e in record.entries("command") if e["event"] == "activate_refused"]
        assert refused
        assert "nobody" in refused[0]["why"]
        chain.client.set_worker("scripted")


def test_it_is_saved_on_request(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with kept(chain, tmp_path) as record:
        done = by_hand(capsys, chain, "save", "it looked odd")
        assert done.code == 0, done.stderr
        (folder,) = record.saved()
        assert str(folder) in done.stdout
        assert "asked: it looked odd" in done.stdout
        (entry,) = record.until("it is logged, too", lambda: record.entries("saved"))
        assert entry["reasons"] == ["asked: it looked odd"]


def test_samples_that_never_arrived_are_named_by_save_log_and_evaluation(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = chain.profile.keys.event("arm")
    with kept(chain, tmp_path) as record:
        stream = Publisher(chain.session, key, Kind.ORDER, "arm#1", Clock())
        for seq in (0, 40, 41):  # a link that was closed and opened again
            if seq:
                time.sleep(1.2 * SHORT.segment_s)
            stream.publish(Event("info", "notice", "test", "still here"), seq=seq)
        done = by_hand(capsys, chain, "save", "a gap")
        assert "but for 39 samples that never arrived" in done.stdout, done.stderr
        (folder,) = record.saved()
        assert record.entries("lost") == [{"samples": {"event/arm": 39}}]
    problems = evaluate_loaded(load_run(folder)).problems
    assert f"samples never reached the recorder: {key} 39" in problems


def test_without_a_rolling_record_a_request_says_so(
    chain: Chain, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "HEARD_S", SOON_S)
    done = by_hand(capsys, chain, "save")
    assert done.code == 1
    assert "no rolling record runs" in done.stderr


def test_the_ring_stays_within_its_bounds_while_it_records(chain: Chain, tmp_path: Path) -> None:
    with kept(chain, tmp_path):
        chain.until(
            "it went round",
            lambda: not (tmp_path / "ring/segment-00000001.mcap").exists(),
        )
        status = chain.client.status(ROLLING)
        assert status is not None
        assert status.counters["dropped"] == 0
        assert status.detail["seconds"] < SHORT.keep_s + 2 * SHORT.segment_s


def test_a_clock_that_is_set_is_told_and_nothing_is_lost(
    chain: Chain,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Set:
        def __getattr__(self, name: str) -> Any:
            return getattr(time, name)

        def time_ns(self) -> int:
            return time.time_ns() - round(STEP_S * 1e9)

    with kept(chain, tmp_path) as record:
        monkeypatch.setattr(clock, "time", Set())
        record.until("it is logged", lambda: record.entries("clock"))
        chain.client.set_prompt("HARD: go down")
        record.until("so is what follows", lambda: record.entries("put"))
        monkeypatch.setattr(clock, "time", time)
        record.until("and the way back", lambda: len(record.entries("clock")) > 1)
        steps_s = [each["step_s"] for each in record.entries("clock")]
        assert steps_s == pytest.approx([-STEP_S, STEP_S], abs=0.1)
        assert by_hand(capsys, chain, "save", "now").code == 0
        (folder,) = record.saved()
    run, states = load_run(folder), chain.profile.keys.state_joint
    samples = run.file.entries(lambda key: key == states)
    numbers = [each.header.seq for each in samples if each.header is not None]
    assert numbers == sorted(numbers), "in the order in which they arrived"
    told = " ".join(run.problems)
    assert f"the wall clock was set by {-STEP_S:+.1f}" in told
    assert f"the wall clock was set by {STEP_S:+.1f}" in told


def test_a_put_without_an_author_and_a_deletion_are_logged_as_they_are(
    chain: Chain, tmp_path: Path
) -> None:
    with kept(chain, tmp_path) as record:
        chain.session.delete(chain.profile.keys.stop)
        whole = zenoh.CongestionControl.BLOCK  # a busy computer may drop parts of it
        chain.session.put(chain.profile.keys.prompt, b"\xff" * 200_000, congestion_control=whole)
        record.until("both are logged", lambda: len(record.entries("put")) == 2)
        deleted, large = record.entries("put")
        assert deleted == {"key": "stop", "text": "", "client": "", "deleted": True}
        assert large["bytes"] == 200_000
        time.sleep(2 * SHORT.after_s)
        assert not (tmp_path / "saved").exists(), "a deletion is no stop"


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system: needs root")
def test_on_a_full_disk_it_says_so_and_goes_on_when_there_is_room(
    chain: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "AGAIN_S", SOON_S)
    small = tmp_path / "small"
    small.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(small)]
    mounted = subprocess.run(words, capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.decode()}")
    try:
        with kept(chain, small / "record") as record:
            filler = small / "filler"
            _fill(filler)
            chain.until("it says so", lambda: _state(chain) == "failed")
            told = [event.what for node, _, event in chain.client.pop_events() if node == ROLLING]
            assert {"recording_failed", "log_failed"} & set(told)
            chain.client.set_prompt("HARD: go up")  # whatever the disk does
            filler.unlink()
            chain.until("it records again", lambda: _state(chain) == "recording")
            record.until("it is logged", lambda: record.entries("disk"))
            assert "HARD: go up" in [each["text"] for each in record.entries("put")]
    finally:
        subprocess.run(["umount", str(small)], check=True)


def _fill(path: Path) -> None:
    with path.open("wb", buffering=0) as out:
        for size in (1024 * 1024, 4096, 1):
            try:
                while True:
                    out.write(b"x" * size)
            except OSError:
                continue


def _detail(chain: Chain) -> Mapping[str, Any]:
    status = chain.client.status(ROLLING)
    return {} if status is None else status.detail


def _state(chain: Chain) -> str:
    status = chain.client.status(ROLLING)
    return "" if status is None else status.state


def test_a_flood_on_one_key_is_counted_and_hides_nothing_on_another(
    chain: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "LOST_EVERY_S", SOON_S)
    with kept(chain, tmp_path) as record:
        with chain.session.declare_publisher(
            chain.profile.keys.speed, congestion_control=zenoh.CongestionControl.BLOCK
        ) as publisher:
            for _ in range(FLOOD):
                publisher.put("100")
        chain.client.set_prompt("HARD: go up", LOGGED_S)  # the command node takes them in order
        record.until("it is logged", lambda: "prompt" in [e["key"] for e in record.entries("put")])
        record.until("the rest is counted", lambda: _logged(record, "speed") == FLOOD)
        assert len(record.entries("put")) < FLOOD / 10


def _logged(record: Kept, key: str) -> int:
    lost = sum(each["puts"] for each in record.entries("lost") if each["key"] == key)
    return lost + len([each for each in record.entries("put") if each["key"] == key])
