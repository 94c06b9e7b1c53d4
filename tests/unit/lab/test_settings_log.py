"""The log of settings: it goes on after a crash, is bounded, and waits for a full disk."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_rolling.settings_log import LOG, SettingsLog, entries_of

from vla_zenoh.errors import RecordingError


def filled(folder: Path, *texts: str, file_bytes: int = 10**6) -> None:
    log = SettingsLog(folder, file_bytes=file_bytes)
    for text in texts:
        log.add("put", 1_000, text=text)
        log.write()
    log.close()


def texts(folder: Path) -> list[str]:
    return [entry["text"] for entry in entries_of(folder)]


def test_a_log_goes_on_where_the_process_before_ended(tmp_path: Path) -> None:
    filled(tmp_path, "one", "two")
    log = SettingsLog(tmp_path)
    assert log.last_what == "put"
    log.close()
    filled(tmp_path, "three", 'a "quoted" prompt\n', "Würfel 🧱")
    assert texts(tmp_path) == ["one", "two", "three", 'a "quoted" prompt\n', "Würfel 🧱"]


@given(cut=st.integers(1, 60))
def test_a_line_that_a_power_cut_left_incomplete_is_cut_off(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    folder = tmp_path_factory.mktemp("log")
    filled(folder, "one", "two")
    path = folder / LOG
    os.truncate(path, path.stat().st_size - cut)
    filled(folder, "three")
    assert texts(folder) == ["one", "three"]


def test_a_log_is_bounded_and_its_newest_lines_are_there(tmp_path: Path) -> None:
    wanted = [f"text {number}" for number in range(60)]
    filled(tmp_path, *wanted, file_bytes=1_000)
    filled(tmp_path, "after a restart", file_bytes=1_000)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2_000
    found = texts(tmp_path)
    assert found == [*wanted, "after a restart"][-len(found) :]
    assert len(found) > 5


def test_lines_wait_for_a_disk_that_is_full(tmp_path: Path) -> None:
    log = SettingsLog(tmp_path)
    log.add("put", 1_000, text="before")
    log.write()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
        log.add("put", 1_001, text="x" * 500)
        for _ in range(2):
            with pytest.raises(RecordingError, match="File too large"):
                log.write()
            assert texts(tmp_path) == ["before"]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    log.add("put", 1_002, text="after")
    log.write()
    log.close()
    assert [len(text) for text in texts(tmp_path)] == [6, 500, 5]


def test_two_processes_do_not_write_one_log(tmp_path: Path) -> None:
    log = SettingsLog(tmp_path)
    with pytest.raises(RecordingError, match="another rolling record writes into"):
        SettingsLog(tmp_path)
    log.close()
    SettingsLog(tmp_path).close()


def test_bytes_that_are_no_line_are_left_out(tmp_path: Path) -> None:
    (tmp_path / LOG).write_bytes(b'\xff\n[1]\n{"what": "put", "text": "one"}\n{"what": "pu')
    assert texts(tmp_path) == ["one"]
