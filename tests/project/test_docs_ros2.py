"""docs/how-to/ros2.md: its lab is secured, and its bridge's file is what the command writes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vla_zenoh.program.main import app

TEXT = (Path(__file__).parents[2] / "docs" / "how-to" / "ros2.md").read_text("utf-8")
RUNNER = CliRunner()


def block(kind: str) -> str:
    (found,) = re.findall(rf"```{kind}\n(.*?)```", TEXT, re.DOTALL)
    return found


def bridge_file(folder: Path, plain: str, *more: str) -> str:
    """Made by the words of the page, below `folder`."""
    (folder / "lab.yaml").write_text(plain)
    init = ["init", "--profile", "./lab.yaml", "--at", "robot=10.0.0.2"]
    done = RUNNER.invoke(app, ["secure", *init, "--folder", str(folder / "certificates")])
    assert done.exit_code == 0, done.output
    words = ["bridge-config", "--profile", "./lab_secure.yaml", *more]
    done = RUNNER.invoke(app, ["profile", *words])
    assert done.exit_code == 0, done.output
    assert f"  vla-zenoh {' '.join(['profile', *words])} > bridge.json5" in TEXT
    assert "ROS_DISTRO=jazzy zenoh-bridge-ros2dds -c bridge.json5" in done.stderr
    return done.stdout


def test_the_bridges_file_of_its_secured_lab_is_what_the_command_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert block("json5") == bridge_file(tmp_path, block("yaml"))


def test_a_bridge_on_a_computer_of_its_own_is_made_as_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plain = block("yaml")
    assert "connect: [tcp/10.0.0.5:7450]" in TEXT
    other = plain.replace("tcp/127.0.0.1:7450", "tcp/10.0.0.5:7450")
    assert other != plain
    found = bridge_file(tmp_path, other, "--certificates", "/home/lab/bridge")
    assert '"listen": {"endpoints": ["tls/10.0.0.5:7450"]}' in found
    assert '"listen_private_key": "/home/lab/bridge/bridge.key"' in found
    assert (tmp_path / "certificates" / "robot" / "bridge.key").exists()
