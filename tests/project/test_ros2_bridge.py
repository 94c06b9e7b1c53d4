"""The script that finds or builds the bridge of the ROS 2 tests."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "ros2_bridge.py"
PROGRAM = "zenoh-bridge-ros2dds"


def run_script(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, SCRIPT, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


def put_program(folder: Path, name: str) -> Path:
    program = folder / name
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    return program


def test_a_bridge_on_path_is_taken(tmp_path: Path) -> None:
    program = put_program(tmp_path, PROGRAM)
    done = run_script(PATH=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert done.returncode == 0
    assert done.stdout == f"ros2-bridge: the bridge is {program}\n"
    assert run_script("--packages", PATH=str(tmp_path)).stdout.strip() == ""
    assert run_script("--path", PATH=str(tmp_path)).stdout == f"{program}\n"
    lacking = run_script("--path", PATH="", XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert (lacking.returncode, lacking.stdout) == (1, "")


def test_what_is_missing_for_building_is_named_with_its_debian_package(tmp_path: Path) -> None:
    put_program(tmp_path, "cargo")
    done = run_script(PATH=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert done.returncode == 1
    assert "cmake" in done.stderr
    assert "a C compiler" in done.stderr
    assert "sudo apt install cmake gcc libc6-dev" in done.stderr
    assert "cargo 1." not in done.stderr
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("name", ["zenoh", "zenoh-plugin-ros2dds"])
def test_the_bridge_is_built_of_the_zenoh_that_python_has(name: str) -> None:
    manifest = tomllib.loads((ROOT / "tests" / "ros2_bridge" / "Cargo.toml").read_text())
    pins = (ROOT / "constraints.txt").read_text().split()
    (ours,) = [pin for pin in pins if pin.startswith("eclipse-zenoh==")]
    assert manifest["dependencies"][name]["version"] == f"={ours.partition('==')[2]}"
