"""Wrong profiles: `profile check` names the fault, and `up` starts nothing.

With `test_wrong_commands.py` these are inputs that people get wrong, each with its sentence.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from typed import typed
from wrong_profiles import BASE, CHECKED, EXTENDED, FILES, WRONG

from vla_zenoh import resources
from vla_zenoh.lab.profile.check import check_profile

LEAST_PROFILES = 60
THROUGH_THE_COMMANDS = WRONG[::25]
"""`test_profile_errors.py` reads all of them: the commands print what that says."""

Write = Callable[..., Path]
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a profile, and what it may name beside it."""

    def write(text: str, extends: str = "panda_sim") -> Path:
        for name, content in FILES.items():
            (tmp_path / name).write_text(content)
        (tmp_path / "base.yaml").write_text(BASE)
        path = tmp_path / "lab.yaml"
        path.write_text(f"extends: {extends}\n{text}\n")
        return path

    return write


def expected(said: str, folder: Path) -> str:
    return said.replace("{here}", str(folder)).replace("{models}", str(resources.shipped("models")))


def test_the_collection_is_large() -> None:
    assert len({text for text, _ in [*WRONG, *CHECKED, *EXTENDED]}) >= LEAST_PROFILES
    assert len(CHECKED) + len(EXTENDED) >= LEAST_PROFILES - 5


@pytest.mark.parametrize(("text", "said"), THROUGH_THE_COMMANDS)
def test_check_and_up_reject_what_is_wrong_by_itself(
    write: Write, capsys: Capture, text: str, said: str
) -> None:
    path = write(text)
    checked, started = typed(capsys, "profile", "check", str(path)), typed(capsys, "up", str(path))
    assert (checked.code, checked.stdout) == (1, "")
    assert (started.code, started.stdout) == (1, "")
    assert said in checked.stderr
    assert said in started.stderr
    assert "Traceback" not in checked.stderr + started.stderr


@pytest.mark.parametrize(("text", "said"), CHECKED)
def test_check_rejects_what_up_would_lose(write: Write, text: str, said: str) -> None:
    path = write(text)
    found = check_profile(str(path)).errors
    assert any(expected(said, path.parent) in line for line in found), found


@pytest.mark.parametrize(("text", "said"), EXTENDED)
def test_the_file_that_contradicts_what_it_extends_is_blamed(
    write: Write, text: str, said: str
) -> None:
    path = write(text, extends="base")
    found = check_profile(str(path)).errors
    assert any(expected(said, path.parent) in line for line in found), found
    assert not any(line.startswith(str(resources.shipped("profiles"))) for line in found), found


def test_up_runs_the_same_check_before_it_starts_anything(write: Write, capsys: Capture) -> None:
    text, said = CHECKED[0]
    path = write(text)
    done = typed(capsys, "up", str(path))
    assert (done.code, done.stdout) == (1, "")
    assert expected(said, path.parent) in done.stderr
    why = f"{path} has faults; `vla-zenoh profile check` lists them too"
    assert done.stderr.endswith(f"error: nothing was started: {why}\n")
