"""Output files and folders: nothing is overwritten unasked, and what was written is kept."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from vla_zenoh.errors import OutputError
from vla_zenoh.lab.cli.output_path import check_folder, output_file, output_folder

Captured = pytest.CaptureFixture[str]
Opened = AbstractContextManager[Path]


def fill(opened: Opened, *steps: Callable[[Path], object]) -> None:
    """Do every step with the temporary file or folder."""
    with opened as part:
        for step in steps:
            step(part)


def refused(opened: Opened, why: str) -> None:
    """Nothing may be written there."""
    with pytest.raises(OutputError, match=why), opened:
        raise AssertionError


def put(text: str, *below: str) -> Callable[[Path], object]:
    return lambda part: part.joinpath(*below).write_text(text)


def fails(error: BaseException) -> Callable[[Path], object]:
    def step(part: Path) -> None:
        raise error

    return step


def disk_is_full(part: Path) -> None:
    Path("/dev/full").write_text("what follows")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# -- files ----------------------------------------------------------------------------------------
def test_a_file_appears_under_its_name_once_it_is_complete(tmp_path: Path) -> None:
    with output_file(tmp_path / "a.html") as part:
        part.write_text("half")
        assert names(tmp_path) == ["a.part.html"]
        part.write_text("whole")
    assert names(tmp_path) == ["a.html"]
    assert (tmp_path / "a.html").read_text() == "whole"


def test_an_existing_file_is_replaced_only_by_force_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    path.chmod(0o600)
    refused(output_file(path), r"a\.json exists; give another --output, or --force")
    with output_file(path, force=True) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o600)
    assert names(tmp_path) == ["a.json"]


def test_an_input_is_never_overwritten_under_no_name(tmp_path: Path) -> None:
    path, link = tmp_path / "a.mcap", tmp_path / "b.mcap"
    path.write_text("run")
    link.symlink_to(path)
    for given in (path, link, tmp_path / "." / "a.mcap"):
        refused(output_file(given, force=True, inputs=[path]), "is an input")
    assert path.read_text() == "run"


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    with output_file(tmp_path / "link.csv") as part:
        part.write_text("1")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "real.csv").read_text() == "1"


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/dev/null", "/dev/null is not a regular file"),
        (".", "is not a regular file"),
        ("/nowhere/a/b.csv", "there is no folder /nowhere/a"),
        ("/proc/b.csv", "/proc/b.csv cannot be written"),
        ("/dev/null/b.csv", "/dev/null/b.csv cannot be written: Not a directory"),
        (f"/tmp/{'n' * 300}.csv", "cannot be written: File name too long"),
    ],
)
def test_a_place_where_no_file_can_be_is_named(path: str, why: str) -> None:
    refused(output_file(Path(path), force=True), why)


@pytest.mark.parametrize(
    ("path", "why"),
    [("/proc/run", "cannot be written: "), ("/dev/null/run", "cannot be written: Not a directory")],
)
def test_a_place_where_no_folder_can_be_is_named(path: str, why: str) -> None:
    refused(output_folder(Path(path)), why)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("no arm"), SystemExit(1)])
def test_what_was_written_before_an_error_is_kept_and_named(
    tmp_path: Path, error: BaseException, capsys: Captured
) -> None:
    for kept in ("a.part.csv", "a.part2.csv"):  # nor does a second failure take the first's place
        with pytest.raises(type(error)):
            fill(output_file(tmp_path / "a.csv"), put(kept), fails(error))
        assert str(tmp_path / kept) in capsys.readouterr().err
    assert names(tmp_path) == ["a.part.csv", "a.part2.csv"]
    assert (tmp_path / "a.part.csv").read_text() == "a.part.csv"


def test_nothing_written_leaves_nothing(tmp_path: Path, capsys: Captured) -> None:
    error = RuntimeError("no arm")
    with pytest.raises(RuntimeError):
        fill(output_file(tmp_path / "a.csv"), fails(error))
    with pytest.raises(RuntimeError):
        fill(output_folder(tmp_path / "run"), lambda part: (part / "images").mkdir(), fails(error))
    assert names(tmp_path) == []
    assert capsys.readouterr().err == ""


def test_a_full_disk_ends_in_a_sentence_and_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"a\.csv cannot be written: No space left on device"):
        fill(output_file(tmp_path / "a.csv"), put("half"), disk_is_full)
    assert names(tmp_path) == ["a.part.csv"]
    for number in (errno.ECONNREFUSED, errno.ENOENT):
        error = OSError(number, os.strerror(number), "/elsewhere")
        with pytest.raises(OSError, match=os.strerror(number)) as caught:
            fill(output_file(tmp_path / "b.csv"), fails(error))
        assert not isinstance(caught.value, OutputError)


def test_a_file_that_another_program_made_meanwhile_is_spared(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with pytest.raises(OutputError, match="made by another program"):
        fill(output_file(path), put("mine"), lambda part: path.write_text("theirs"))
    assert (path.read_text(), (tmp_path / "a.part.csv").read_text()) == ("theirs", "mine")


# -- folders --------------------------------------------------------------------------------------
def test_two_runs_are_never_mixed_and_force_moves_the_older_one_aside(
    tmp_path: Path, capsys: Captured
) -> None:
    path = tmp_path / "run"
    with output_folder(path) as part:
        (part / "plot.png").write_text("first")
        assert names(tmp_path) == ["run.part"]
    refused(output_folder(path), r"run exists; give another --output, or --force")
    for number in ("", "2"):
        with output_folder(path, force=True) as part:
            (part / "tasks.jpg").write_text("next")
        assert str(tmp_path / f"run.old{number}") in capsys.readouterr().err
    assert names(path) == ["tasks.jpg"]
    assert names(tmp_path / "run.old") == ["plot.png"]
    assert names(tmp_path) == ["run", "run.old", "run.old2"]


def test_an_empty_folder_may_be_filled_and_an_input_is_not_moved(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    with output_folder(path) as part:
        (part / "a").write_text("1")
    refused(output_folder(path, force=True, inputs=[path / "a"]), "holds an input")
    assert names(path) == ["a"]


def test_the_current_folder_is_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (".", "..", str(tmp_path)):
        refused(output_folder(Path(path), force=True), "is the current folder")


def test_a_folder_that_is_half_full_after_an_error_is_kept(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="run cannot be written: No space left"):
        fill(output_folder(tmp_path / "run"), put("recorded", "run.mcap"), disk_is_full)
    assert names(tmp_path / "run.part") == ["run.mcap"]


def test_a_folder_of_several_calls_takes_no_strange_files(tmp_path: Path) -> None:
    path = tmp_path / "trial"
    check_folder(path, begun=False)
    assert names(path) == []
    (path / "plan.json").write_text("{}")
    check_folder(path, begun=True)
    with pytest.raises(OutputError, match="exists and holds something else"):
        check_folder(path, begun=False)


def test_only_the_folder_runs_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with output_file(Path("runs/a.csv")) as part:
        part.write_text("1")
    assert Path("runs/a.csv").read_text() == "1"
    refused(output_folder(Path("results/run")), "there is no folder results")
