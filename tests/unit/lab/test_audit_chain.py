"""An audit log: whatever is done to its lines afterwards shows."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from vla_zenoh.cli.main import app
from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.rolling.audit_log import (
    FIRST,
    AuditLog,
    Link,
    line_after,
    lines_of,
    verify,
    verify_folder,
)

TEXTS = ("red brick", "true", 'a "quoted" prompt\n', "Würfel 🧱", "")


def chain(count: int = 5) -> list[str]:
    link, lines = Link(), []
    for number in range(count):
        facts = {"key": "prompt", "text": TEXTS[number % len(TEXTS)], "client": "ab12"}
        line, link = line_after(link, 1_000 + number, "put", facts)
        lines.append(line)
    return lines


def test_a_chain_that_nobody_touched_has_no_fault() -> None:
    found = verify(chain())
    assert (found.lines, found.first, found.faults) == (5, 0, [])
    assert found.head == json.loads(chain()[-1])["hash"]
    assert json.loads(chain()[0])["before"] == FIRST


@given(st.integers(0, 4), st.data())
def test_an_edited_character_shows(at: int, data: st.DataObject) -> None:
    lines = chain()
    place = data.draw(st.integers(0, len(lines[at]) - 1))
    other = data.draw(st.characters(codec="ascii").filter(lambda c: c != lines[at][place]))
    lines[at] = lines[at][:place] + other + lines[at][place + 1 :]
    assert verify(lines).faults


def test_an_edit_with_a_hash_made_anew_shows_at_the_next_line() -> None:
    lines = chain()
    before = Link(1, json.loads(lines[0])["hash"])
    lines[1], _ = line_after(before, 1_001, "put", {"text": "something else"})
    (fault,) = verify(lines).faults
    assert "line 3 (number 2) does not follow the one before" in fault


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_removed_line_shows(at: int) -> None:
    lines = chain()
    del lines[at]
    (fault,) = verify(lines).faults
    assert fault == f"before line {at + 1} (number {at + 1}): 1 removed"


def test_a_line_that_was_moved_or_doubled_shows() -> None:
    lines = chain()
    assert verify([lines[0], lines[2], lines[1], *lines[3:]]).faults
    assert verify([*lines[:3], lines[2], *lines[3:]]).faults


def test_what_is_removed_at_the_end_shows_by_a_hash_that_is_known_from_elsewhere() -> None:
    head = json.loads(chain()[-1])["hash"]
    assert verify(chain()).has(head)
    shorter = verify(chain()[:-1])
    assert shorter.faults == []
    assert not shorter.has(head)


def test_what_is_missing_by_the_logs_own_words_is_told_apart_from_what_was_removed() -> None:
    lines = chain(2)
    link = Link(2, json.loads(lines[-1])["hash"])
    line, _ = line_after(link, 2_000, "lost", {"puts": 7})
    found = verify([*lines, line])
    assert found.faults == []
    assert found.gaps == ['number 2: lost {"puts":7}']


# -- on disk --------------------------------------------------------------------------------------
def filled(folder: Path, *texts: str, file_bytes: int = 10**6) -> None:
    log = AuditLog(folder, file_bytes=file_bytes)
    for text in texts:
        log.add("put", 1_000, text=text)
        log.write()
    log.close()


def test_a_log_goes_on_where_the_process_before_ended(tmp_path: Path) -> None:
    filled(tmp_path, "one", "two")
    filled(tmp_path, "three")
    found = verify_folder(tmp_path)
    assert found.faults == []
    assert [entry["facts"]["text"] for entry in found.entries] == ["one", "two", "three"]


@given(cut=st.integers(1, 60))
def test_a_line_that_a_power_cut_left_incomplete_is_cut_off_and_the_chain_goes_on(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    folder = tmp_path_factory.mktemp("log")
    filled(folder, "one", "two")
    (path,) = folder.iterdir()
    os.truncate(path, path.stat().st_size - cut)
    log = AuditLog(folder)
    assert log.cut_bytes > 0
    log.add("put", 2_000, text="three")
    log.write()
    log.close()
    found = verify_folder(folder)
    assert found.faults == []
    assert [entry["facts"]["text"] for entry in found.entries] == ["one", "three"]


def test_a_log_is_bounded_and_says_that_its_beginning_is_gone(tmp_path: Path) -> None:
    filled(tmp_path, *(f"text {number}" for number in range(60)), file_bytes=1_000)
    filled(tmp_path, "after a restart", file_bytes=1_000)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 10_000
    found = verify_folder(tmp_path)
    assert found.faults == []
    assert found.first > 0
    assert found.entries[-1]["facts"]["text"] == "after a restart"


def test_lines_wait_for_a_disk_that_is_full(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.add("put", 1_000, text="before")
    log.write()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
        log.add("put", 1_001, text="x" * 500)
        for _ in range(2):
            with pytest.raises(RecordingError, match="File too large"):
                log.write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    log.add("put", 1_002, text="after")
    log.write()
    log.close()
    found = verify_folder(tmp_path)
    assert found.faults == []
    assert [len(entry["facts"]["text"]) for entry in found.entries] == [6, 500, 5]


def test_two_processes_do_not_write_one_log(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    with pytest.raises(RecordingError, match="another rolling record writes into"):
        AuditLog(tmp_path)
    log.close()
    AuditLog(tmp_path).close()


# -- the command ----------------------------------------------------------------------------------
def test_the_command_verifies_and_says_what_was_done(tmp_path: Path) -> None:
    filled(tmp_path, "one", "two", "three")
    done = CliRunner().invoke(app, ["lab", "audit", str(tmp_path), "--show"])
    assert done.exit_code == 0, done.output
    assert "text='two', by a client that does not say who it is" in done.output
    (path,) = tmp_path.iterdir()
    lines = list(lines_of(tmp_path))
    head = json.loads(lines[-1])["hash"]
    path.write_text("".join(f"{line}\n" for line in (lines[0], lines[2])))
    done = CliRunner().invoke(app, ["lab", "audit", str(tmp_path), "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["faults"] == ["before line 2 (number 2): 1 removed"]
    path.write_text(f"{lines[0]}\n")
    assert CliRunner().invoke(app, ["lab", "audit", str(tmp_path)]).exit_code == 0
    done = CliRunner().invoke(app, ["lab", "audit", str(tmp_path), "--head", head])
    assert done.exit_code == 1
    assert "its end was removed" in " ".join(done.output.split())


def test_a_folder_without_a_log_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="has no audit log"):
        verify_folder(tmp_path)
