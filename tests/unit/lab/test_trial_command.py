"""``vla-zenoh trial`` without a robot: what a person types, what is refused, and the report."""

from __future__ import annotations

import json
import os
import pty
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner
from vla_zenoh_trial.cli import trial
from vla_zenoh_trial.episode_fsm import EpisodeFsm
from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.person import Lines, TrialPerson
from vla_zenoh_trial.plan import DueEpisode, TrialPlan
from vla_zenoh_trial.verdict import End, EpisodeVerdict

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.episode import EpisodeView, Interrupted

PLAN = TrialPlan("panda", ("ann", "bob"), "wave", ("left", "right"), 20.0, 7, True)
SOON_S = 0.05


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    read, write = os.pipe()
    yield read, write
    os.close(read)


def person(fd: int, *, plan: TrialPlan = PLAN, lays: bool = False) -> TrialPerson:
    return TrialPerson(plan, fd, threading.Event(), lays=lays)


def laid() -> EpisodeFsm:
    return EpisodeFsm(DueEpisode(1, 1, "ann"), 20.0)


def running() -> EpisodeFsm:
    episode = laid()
    episode.enter("")
    episode.started(0.0, 1, None)
    return episode


# -- lines ----------------------------------------------------------------------------------------
def test_lines_come_one_by_one_and_the_last_needs_no_line_feed(pipe: tuple[int, int]) -> None:
    read, write = pipe
    lines = Lines(read)
    assert lines.take(0.0) is None
    os.write(write, b"y fine\r\n\nn")
    assert lines.peek(SOON_S) == "y fine"
    assert [lines.take(SOON_S) for _ in range(3)] == ["y fine", "", None]
    assert not lines.over
    os.close(write)
    assert [lines.take(SOON_S), lines.take(SOON_S)] == ["n", None]
    assert lines.over


def test_while_an_episode_runs_a_script_ends_it_by_an_empty_line_alone(
    pipe: tuple[int, int],
) -> None:
    read, write = pipe
    someone = person(read)
    os.write(write, b"\ny well done\n")
    assert someone.ask(laid()) == ""
    assert someone.poll_line() is None, "the verdict stays until it is asked for"
    os.write(write, b"\n")
    assert someone.poll_line() is None
    episode = running()
    episode.update(EpisodeView(), 30.0)
    episode.stopped(EpisodeView())
    assert someone.ask(episode) == "y well done"
    assert someone.poll_line() == ""
    assert someone.poll_line() is None
    os.close(write)
    with pytest.raises(NodeError, match="has ended while an episode runs"):
        someone.poll_line()
    with pytest.raises(NodeError, match="the same command continues"):
        someone.ask(laid())


def test_a_script_whose_lines_are_not_where_they_belong_is_stopped(pipe: tuple[int, int]) -> None:
    read, write = pipe
    episode, someone = laid(), person(read)
    os.write(write, b"y\n")
    line = someone.ask(episode)
    assert not episode.enter(line)
    with pytest.raises(NodeError, match="'y' is not valid here: an empty line when it is set up"):
        someone.reject_line(line, episode.phase)
    os.close(write)


def test_setups_that_are_laid_already_are_not_asked_for(
    pipe: tuple[int, int], capsys: pytest.CaptureFixture[str]
) -> None:
    read, write = pipe
    assert person(read, lays=True).ask(laid()) == ""
    assert "episode 1 of 4: setup 1, left" in capsys.readouterr().err
    os.close(write)


@pytest.mark.parametrize("end", ["taken", "stopped", "lost"])
def test_after_an_episode_that_was_taken_away_a_person_is_asked_whatever_was_said_before(
    pipe: tuple[int, int], capsys: pytest.CaptureFixture[str], end: End
) -> None:
    read, write = pipe
    os.write(write, b"\n")
    assert person(read, lays=True).ask(EpisodeFsm(DueEpisode(1, 2, "bob"), 20.0, end)) == ""
    assert "the arm was deactivated" in capsys.readouterr().err
    os.close(write)
    with pytest.raises(NodeError, match="has ended before the trial"):
        person(read, lays=True).ask(EpisodeFsm(DueEpisode(1, 2, "bob"), 20.0, end))


def test_ctrl_c_ends_a_question(pipe: tuple[int, int]) -> None:
    read, write = pipe
    someone = person(read)
    someone._stop.set()
    with pytest.raises(Interrupted):
        someone.ask(laid())
    os.close(write)


def test_at_a_terminal_an_enter_too_many_moves_no_arm(capsys: pytest.CaptureFixture[str]) -> None:
    master, slave = pty.openpty()
    try:
        someone = person(slave)
        os.write(master, b"\n\n")
        assert Lines(slave).peek(1.0) == "", "it is there"
        os.write(master, b"\n")
        answered = threading.Event()

        def type_until_answered() -> None:
            while not answered.wait(SOON_S):
                os.write(master, b"now\n")

        typing = threading.Thread(target=type_until_answered)
        typing.start()
        assert someone.ask(laid()) == "now"
        answered.set()
        typing.join()
        someone._lines.forget()
        os.write(master, b"y in one go\n")
        assert Lines(slave).peek(1.0) == "y in one go"
    finally:
        os.close(master)
        os.close(slave)


def test_who_is_at_work_is_told_in_an_open_trial_alone(
    pipe: tuple[int, int], capsys: pytest.CaptureFixture[str]
) -> None:
    read, write = pipe
    episode = running()
    episode.update(EpisodeView(False), 1.0)
    episode.stopped(EpisodeView(False, why="node 'worker-ann' is gone"))
    for is_blind in (True, False):
        plan = TrialPlan("panda", ("ann", "bob"), "wave", ("left",), 20.0, 7, is_blind)
        someone = person(read, plan=plan, lays=True)
        someone.ask(laid())
        someone.show_end(episode)
        said = capsys.readouterr().err
        assert said.count("ann") == (0 if is_blind else 2)
        assert "the command node braked and ended it: node" in said
    os.close(write)


# -- the command ----------------------------------------------------------------------------------
def run(*words: str) -> Result:
    app = typer.Typer()
    app.command()(trial)
    return CliRunner().invoke(app, list(words), env={"COLUMNS": "200", "NO_COLOR": "1"})


def judged(setup: int, worker: str, success: bool) -> EpisodeVerdict:
    return EpisodeVerdict(
        *(1, setup, 1, worker, "success" if success else "failure", "", "person", "", 4.0, 9, 0),
        *(1, None, "episode-0001.mcap", 0),
    )


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    folder = TrialFolder(tmp_path / "ab")
    with folder.lock():
        folder.begin(PLAN)
    for setup, worker, success in ((1, "ann", True), (1, "bob", False), (2, "ann", True)):
        folder.append(judged(setup, worker, success))
    return folder.path


def test_the_report_says_who_succeeded_how_often(begun: Path) -> None:
    done = run("--output", str(begun), "--report")
    assert done.exit_code == 0, done.output
    assert "3 of 4 episodes done: p and intervals hold where" in done.stderr
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines()[1:4]}
    assert rows["ann"][:4] == ["ann", "2", "2", "100.0%"]
    assert rows["bob"][:4] == ["bob", "0", "1", "0.0%"]
    assert "ann minus bob over 1 setups that both did: +100.0%" in done.stdout
    assert "exact McNemar p = 1;" in done.stdout


def test_the_report_as_json_has_all_of_it(begun: Path) -> None:
    TrialFolder(begun).append(judged(2, "bob", False))
    done = run("--output", str(begun), "--report", "--json")
    assert done.exit_code == 0, done.output
    assert done.stderr == ""
    found = json.loads(done.stdout)
    assert (found["done"], found["of"]) == (4, 4)
    assert found["workers"]["ann"]["rate"] == 1.0
    assert (found["paired"]["first"], found["paired"]["p"]) == (2, 0.5)
    assert found["plan"]["setups"] == ["left", "right"]
    assert [each["worker"] for each in found["episodes"]] == ["ann", "bob", "ann", "bob"]


def test_a_trial_that_is_done_is_reported_without_a_robot(begun: Path) -> None:
    TrialFolder(begun).append(judged(2, "bob", False))
    done = run("--output", str(begun), "--workers", "ann,bob")
    assert done.exit_code == 0, done.output
    assert "4 of 4 episodes" in done.stdout


def test_other_arguments_than_those_it_was_begun_with_are_refused(
    begun: Path, tmp_path: Path
) -> None:
    setups = tmp_path / "setups.txt"
    setups.write_text("left\n\n  right \nmiddle\n")
    words = ("--workers", "bob, ann", "--setups", str(setups), "--open")
    done = run("--output", str(begun), *words)
    assert done.exit_code == 1
    said = " ".join(done.stderr.split())
    assert "has another plan: workers ann, bob, not bob, ann;" in said
    assert "setups left, right, not left, right, middle; blind True, not False" in said
    assert "give another --output" in said


@pytest.mark.parametrize(
    ("words", "code", "why"),
    [
        (["--prompt", "wave"], 2, "--workers is required"),
        (["--workers", "ann"], 2, "--prompt is required"),
        (["--workers", "ann", "--setups", "x", "--episodes", "3"], 2, "leave --episodes out"),
        (["--workers", "ann", "--setups", "/no/such/file"], 1, "cannot be read"),
        (["--report"], 1, "holds no trial"),
    ],
)
def test_what_cannot_be_begun_leaves_nothing_behind(
    tmp_path: Path, words: list[str], code: int, why: str
) -> None:
    done = run("--output", str(tmp_path / "new"), *words)
    assert done.exit_code == code
    assert why in " ".join(done.stderr.replace("│", " ").split())
    assert not (tmp_path / "new" / "plan.json").exists()
