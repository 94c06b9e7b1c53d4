"""The operator of examples/wire/c in the real chain, where zenoh-pico is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from chain import Chain
from wire_rig import CLIENTS, arguments_of, running

pytestmark = pytest.mark.clients

SOURCE = CLIENTS / "c" / "operator.c"
PACKAGE = "zenohpico"
SECONDS = 30


@pytest.fixture
def operator(tmp_path: Path) -> Path:
    if shutil.which("cc") is None or shutil.which("pkg-config") is None:
        pytest.skip("no cc, or no pkg-config")
    asked = ["pkg-config", "--cflags", "--libs", PACKAGE]
    found = subprocess.run(asked, capture_output=True, text=True, check=False)
    if found.returncode != 0:
        pytest.skip(f"pkg-config finds no {PACKAGE}: install zenoh-pico")
    folder = subprocess.run(
        ["pkg-config", "--variable=prefix", PACKAGE], capture_output=True, text=True, check=True
    ).stdout.strip()
    program = tmp_path / "operator"
    words = ["cc", "-DZENOH_LINUX", "-std=c11", "-Wall", "-Wextra", "-Werror", "-o", str(program)]
    words += [str(SOURCE), *found.stdout.split(), f"-Wl,-rpath,{folder}/lib"]
    subprocess.run(words, check=True)
    return program


def words_of(operator: Path, chain: Chain, prompt: str) -> list[str]:
    arguments = arguments_of(chain.profile, "scripted", prompt, str(SECONDS))
    return [str(operator), *arguments]


def test_the_arm_is_active_for_as_long_as_the_operator_in_c_lives(
    operator: Path, chain: Chain
) -> None:
    chain.settle()
    with running(words_of(operator, chain, "HARD: go up")) as process:
        chain.until("it moves", chain.moves)
        process.kill()
        chain.until("it is inactive", lambda: chain.state() == "inactive")
    chain.settle()
    with running(words_of(operator, chain, "HARD: go down")) as process:
        chain.until("it moves", chain.moves)
        process.send_signal(2)
        assert process.wait(10) == 0
        chain.until("it is stopped", lambda: chain.state() == "stopped")
    chain.settle()


def test_the_operator_in_c_says_why_the_arm_is_not_activated(operator: Path, chain: Chain) -> None:
    chain.settle()
    chain.client.stop()
    chain.until("it is stopped", lambda: chain.state() == "stopped")
    done = subprocess.run(
        words_of(operator, chain, "hold"), capture_output=True, text=True, check=False, timeout=30
    )
    assert done.returncode == 1
    assert "activate_refused" in done.stdout, done
    assert "emergency stop" in done.stdout, done
    assert "not activated" in done.stderr, done
    chain.settle()
