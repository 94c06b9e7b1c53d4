"""``vla-zenoh trial`` on a simulated arm with two workers, judged by lines on stdin."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from camera_rig import until
from chain import READY_PATIENCE_S, Chain, running_chain
from vla_zenoh_dataset.episodes import episodes_of
from vla_zenoh_dataset.success import succeeded
from vla_zenoh_trial.folder import TrialFolder

from vla_zenoh.lab.recording.run import load_run

pytestmark = pytest.mark.slow

WORKERS = ("scripted", "twin")
SHORT, ENDLESS = "HARD: go up x3", "HARD: go up within 0.05"
END_S = 30.0

MODELS = """\
workers: [scripted, twin]
models: {twin: scripted}
"""


@pytest.fixture(scope="module")
def shared_chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    """Two workers of one model, with all else as in other files."""
    with running_chain(tmp_path_factory.mktemp("trial"), more=MODELS) as chain:
        for worker in WORKERS:
            chain.until(
                f"{worker} infers",
                lambda worker=worker: chain.state(f"worker-{worker}") == "inferring",
                READY_PATIENCE_S,
            )
        chain.activate_when_ready()
        yield chain


@contextmanager
def trial(
    chain: Chain, out: Path, *words: str, stdin: int = subprocess.PIPE, err: int = subprocess.PIPE
) -> Iterator[subprocess.Popen[str]]:
    """The command at work, ended with the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "vla_zenoh", "trial", "--output", str(out), *words],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=err,
        text=True,
        env={
            **os.environ,
            "VLA_ZENOH_PROFILE": str(chain.profile_file),
            "COLUMNS": "200",
            "NO_COLOR": "1",
        },
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def answered(chain: Chain, out: Path, answers: str, *words: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a whole trial whose answers are there from the beginning."""
    with trial(chain, out, *words) as process:
        said, told = process.communicate(answers, timeout=4 * END_S)
    return process.returncode, said, told


def begin(prompt: str, *more: str) -> tuple[str, ...]:
    words = ("--workers", ",".join(WORKERS), "--prompt", prompt, "--episodes", "1", "--seed", "3")
    return (*words, *more)


def test_two_workers_are_tried_blind_and_their_verdicts_stand_in_table_and_recordings(
    chain: Chain, tmp_path: Path
) -> None:
    out = tmp_path / "ab"
    answers = "y pushed it\nn\n"
    code, said, told = answered(
        chain, out, answers, *begin(SHORT, "--seconds", "20"), "--yes-setup", "--json"
    )
    assert code == 0, told
    found: dict[str, Any] = json.loads(said)
    folder = TrialFolder(out)
    first, second = folder.episodes()
    assert {first.worker, second.worker} == set(WORKERS)
    assert (first.verdict, first.note, second.verdict) == ("success", "pushed it", "failure")
    for each in (first, second):
        assert each.end == "policy", each
        assert each.chunks >= 3
        assert each.start_m is not None
    assert found["workers"][first.worker]["successes"] == 1
    assert found["paired"]["setups"] == 1
    assert not any(worker in told for worker in WORKERS), "nobody is told who it was"

    for each in (first, second):
        run = load_run(out / each.recording)
        assert not run.problems
        (episode,) = episodes_of(run)
        assert episode.worker == each.worker
        assert succeeded(episode) is (each.verdict == "success")
    assert chain.state() == "inactive"
    assert chain.detail("at_rest")


def test_ctrl_c_brakes_the_arm_and_the_same_command_goes_on(chain: Chain, tmp_path: Path) -> None:
    out, words = tmp_path / "ab", begin(ENDLESS, "--seconds", "3")
    with trial(chain, out, *words) as process:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
        chain.until("it moves", chain.moves, READY_PATIENCE_S)
        process.send_signal(signal.SIGINT)
        process.wait(END_S)
        _, told = process.communicate(timeout=END_S)
    assert process.returncode == 130, told
    assert "0 of 2 done; the same command continues" in told
    assert chain.state() == "inactive"
    assert chain.detail("at_rest")
    (broken,) = TrialFolder(out).episodes()
    assert (broken.verdict, broken.end) == ("void", "broken_off")

    code, said, told = answered(chain, out, "\ny\n\nx bumped\n\nn\n", *words, "--json")
    assert code == 0, told
    episodes = TrialFolder(out).episodes()
    assert [each.verdict for each in episodes] == ["void", "success", "void", "failure"]
    assert episodes[1].worker == broken.worker
    assert episodes[2].worker == episodes[3].worker != broken.worker
    assert {each.end for each in episodes[1:]} == {"time"}
    assert [each.number for each in episodes] == [1, 2, 3, 4]
    assert {each["void"] for each in json.loads(said)["workers"].values()} == {1}


def test_an_arm_that_is_not_given_is_repaired_and_a_stopped_one_is_told(
    chain: Chain, tmp_path: Path
) -> None:
    out = tmp_path / "ab"
    chain.client.publish(chain.client.keys.stop, "")
    chain.until("stopped", lambda: chain.state() == "stopped")
    with trial(chain, out, *begin(ENDLESS), "--yes-setup") as process:
        assert process.stdin is not None
        assert process.stderr is not None
        told: list[str] = []
        reading = threading.Thread(target=lambda: told.extend(process.stderr or ()))
        reading.start()
        until("it is told why", lambda: "emergency stop" in "".join(told), READY_PATIENCE_S)
        chain.client.publish(chain.client.keys.reset, "")
        chain.until("reset", lambda: chain.state() == "inactive")
        process.stdin.write("\n")
        process.stdin.flush()
        chain.until("it moves", chain.moves, READY_PATIENCE_S)
        chain.client.publish(chain.client.keys.stop, "")
        until("it is over", lambda: "stopped by an emergency stop" in "".join(told), END_S)
        process.stdin.write("n it was about to hit the box\n")
        process.stdin.close()
        process.wait(END_S)
        reading.join(END_S)
        process.stdin = None  # it is closed already
    (first,) = TrialFolder(out).episodes()
    assert (first.verdict, first.end, first.why) == ("failure", "stopped", "emergency stop")
    assert process.returncode == 1, "the other worker was not tried"
    assert "standard input has ended before the trial" in "".join(told)
    assert len(list(out.glob("*.mcap"))) == 1, "what was refused left no recording"


class Terminal:
    """A terminal, and what was shown on it; to be closed."""

    def __init__(self) -> None:
        self.shown = bytearray()
        self._master, self.fd = pty.openpty()
        self._over = threading.Event()
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        while not self._over.is_set():
            if select.select([self._master], [], [], 0.05)[0]:
                self.shown.extend(os.read(self._master, 4096))

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def close(self) -> None:
        self._over.set()
        self._reading.join()
        os.close(self._master)
        os.close(self.fd)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    made.close()


def lay_and_move(chain: Chain, terminal: Terminal, number: int) -> None:
    """Answer the question for the setup of the episode with this number."""
    asked = f"episode {number} of 2: setup 1".encode()
    until("it asks", lambda: asked in terminal.shown, READY_PATIENCE_S)
    until("for the setup", lambda: terminal.shown.count(b"set it up") == number)
    terminal.type(b"\n")
    chain.until("it moves", chain.moves, READY_PATIENCE_S)
    until("it shows how it goes", lambda: b"Enter ends it" in terminal.shown)


def test_at_a_terminal_enter_ends_an_episode_and_nothing_tells_who_it_was(
    chain: Chain, tmp_path: Path, terminal: Terminal
) -> None:
    out, shown = tmp_path / "ab", terminal.shown
    with trial(chain, out, *begin(ENDLESS), stdin=terminal.fd, err=terminal.fd) as process:
        for number, verdict in enumerate((b"y\n", b"n dropped it\n"), 1):
            lay_and_move(chain, terminal, number)
            terminal.type(b"\n")
            until("it asks", lambda n=number: shown.count(b"did it succeed?") == n, END_S)
            assert chain.state() == "inactive"
            terminal.type(verdict)
        process.wait(END_S)
    assert process.returncode == 0, bytes(shown).decode()
    first, second = TrialFolder(out).episodes()
    assert (first.verdict, second.verdict) == ("success", "failure")
    assert {first.end, second.end} == {"person"}
    assert second.note == "dropped it"
    assert not any(worker.encode() in shown for worker in WORKERS)


def test_a_terminal_that_takes_no_output_does_not_keep_an_arm_moving(
    chain: Chain, tmp_path: Path, terminal: Terminal
) -> None:
    words = begin(ENDLESS)
    with trial(chain, tmp_path / "ab", *words, stdin=terminal.fd, err=terminal.fd) as process:
        lay_and_move(chain, terminal, 1)
        terminal.type(b"\x13")  # Ctrl-S
        shown = -1

        def silent() -> bool:
            nonlocal shown
            before, shown = shown, len(terminal.shown)
            time.sleep(1.0)  # it would show something five times meanwhile
            return shown == before

        until("nothing is shown", silent, END_S)
        assert chain.state() in ("active", "holding")
        process.send_signal(signal.SIGINT)
        chain.until("the arm is braked", lambda: chain.state() == "inactive")
        terminal.type(b"\x11")  # Ctrl-Q
        assert process.wait(END_S) == 130
