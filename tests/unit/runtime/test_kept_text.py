"""The file that keeps an emergency stop: what the disk does must not reach the loop."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from vla_zenoh.runtime.kept_text import KeptText

PATIENCE_S = 10.0
WHY = "stop: by hand"


def failure_of(latch: KeptText) -> str:
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        why = latch.failure()
        if why is not None:
            return why
        time.sleep(0.005)
    raise AssertionError("no failure is told")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "run" / "stopped"


def test_it_stands_until_it_is_taken_away_and_the_last_word_counts(file: Path) -> None:
    for words, stands in (([WHY], WHY), ([WHY, None], None), ([None, "one", WHY], WHY)):
        latch = KeptText(file)
        for why in words:
            latch.set(why)
        latch.close()
        assert KeptText(file).read() == stands
        assert latch.failure() is None


def test_a_folder_that_was_tidied_away_is_made_again(file: Path) -> None:
    assert not file.parent.exists()
    latch = KeptText(file)
    latch.set(WHY)
    latch.close()
    assert file.read_text() == WHY


def test_what_cannot_be_written_is_told_and_hinders_nobody(file: Path) -> None:
    file.mkdir(parents=True)
    latch = KeptText(file)
    latch.set(WHY)
    assert "stopped cannot be written" in failure_of(latch)
    assert latch.failure() is None
    latch.set(None)
    assert "stopped cannot be removed" in failure_of(latch)


def test_what_cannot_be_read_stands(file: Path) -> None:
    file.mkdir(parents=True)
    why = KeptText(file).read()
    assert why is not None
    assert "cannot be read" in why
