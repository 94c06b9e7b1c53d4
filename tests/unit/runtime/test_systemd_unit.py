"""The systemd unit of `up`."""

from __future__ import annotations

import configparser
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vla_zenoh.cli.main import app
from vla_zenoh.runtime.systemd_unit import systemd_unit

COMMAND = [sys.executable, "-m", "vla_zenoh", "up", "/home/lab/my arm.yaml", "--host", "robot"]


def parsed(text: str) -> configparser.ConfigParser:
    unit = configparser.ConfigParser(interpolation=None, strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read_string(text)
    return unit


def test_a_unit_runs_the_command_as_the_user_and_leaves_time_to_brake() -> None:
    service = parsed(systemd_unit("panda on robot", COMMAND, "lab", {}))["Service"]
    assert service["User"] == "lab"
    assert service["ExecStart"].endswith('up "/home/lab/my arm.yaml" --host robot')
    assert service["KillMode"] == "mixed"
    assert float(service["TimeoutStopSec"]) > 3.0


@pytest.mark.parametrize(
    ("word", "written"),
    [
        ("a b", '"a b"'),
        ("50%", "50%%"),
        ("$HOME", "$$HOME"),
        ('say "x"', '"say \\"x\\""'),
        ("back\\slash", '"back\\\\slash"'),
        ("", '""'),
    ],
)
def test_words_are_quoted_as_systemd_reads_them(word: str, written: str) -> None:
    service = parsed(systemd_unit("arm", ["/bin/echo", word], "lab", {}))["Service"]
    assert service["ExecStart"] == f"/bin/echo {written}"


def test_a_unit_carries_the_variables_that_find_profiles() -> None:
    text = systemd_unit("arm", ["/bin/true"], "lab", {"VLA_ZENOH_PATH": "/srv/my lab"})
    assert 'Environment="VLA_ZENOH_PATH=/srv/my lab"' in text


def test_a_word_with_a_line_break_is_rejected_by_name() -> None:
    with pytest.raises(ValueError, match=r"'a\\nb' has characters"):
        systemd_unit("arm", ["/bin/echo", "a\nb"], "lab", {})


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    path = tmp_path / "vla-zenoh-robot.service"
    path.write_text(systemd_unit("panda on robot", COMMAND, "root", {"A": "1 2"}))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert str(path.name) not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr


def test_up_prints_a_unit_that_runs_this_profile_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lab.yaml").write_text("extends: panda_sim\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VLA_ZENOH_PATH", "/srv/lab")
    result = CliRunner().invoke(app, ["up", "./lab.yaml", "--print-unit", "--dry-run"])
    assert result.exit_code == 0, result.output
    service = parsed(result.stdout)["Service"]
    words = shlex.split(service["ExecStart"])
    assert words[:4] == [sys.executable, "-m", "vla_zenoh", "up"]
    assert Path(words[4]) == tmp_path / "lab.yaml"
    assert words[5] == "--host"
    assert words[-1] == "--dry-run"
    assert service["Environment"] == "VLA_ZENOH_PATH=/srv/lab"
