"""The package works where none of the packages in plugins/ is installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

import pytest
from camera_rig import free_endpoint

from vla_zenoh import plugins

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment that has all of this one but the packages in plugins/."""
    site = tmp_path_factory.mktemp("site")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if not entry.name.lstrip("_").startswith("vla_zenoh_"):
            (site / entry.name).symlink_to(entry)
    robots = next(iter(site.glob("cmeel.prefix/lib/python*/site-packages")))
    path = os.pathsep.join(map(str, (ROOT / "src", site, robots)))
    (site / "cryptography").unlink()  # of the extra secure
    return {**os.environ, "PYTHONPATH": path}


MANY = """
import contextlib, io, json, os, sys
from vla_zenoh.program.entry import main

told = []
for words, environment in json.load(sys.stdin):
    sys.argv, out, said, code = ["vla-zenoh", *words], io.StringIO(), io.StringIO(), 0
    os.environ.update(environment)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    for name in environment:
        del os.environ[name]
    told.append((code, out.getvalue(), said.getvalue()))
json.dump(told, sys.stdout)
"""
WAYS = ((), ("--help",), ("a-word", "--an-option=1"))
FIRST, *OTHERS = plugins.PACKAGES
COMMANDS = [*((FIRST, after) for after in WAYS), *((command, ("--help",)) for command in OTHERS)]
LAB = """\
extends: panda_sim
hosts: {here: {nodes: [router, sim, camera, command, worker, primitives]}}
"""
SMALL = """\
extends: panda_sim
cameras: {wrist: null}
hosts: {here: {nodes: [router, sim, camera, command]}}
"""
PREPARED = "openpi in an environment of its own"
LINES = [
    *("profile check panda_sim", "profile check fr3", "profile show fr3", "doctor --json"),
    *("node --help", "worker openpi", "up lab.yaml --dry-run"),
]


class Said(NamedTuple):
    """What a command ended with."""

    code: int
    stdout: str
    stderr: str


@pytest.fixture(scope="module")
def said(alone: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Said]:
    """Command line -> what became of it; one process runs them all: they need the same imports."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "lab.yaml").write_text(LAB, "utf-8")
    asked = {line: (line.split(), {}) for line in LINES}
    for command, after in COMMANDS:
        words = [*command.split("."), *after]
        asked[" ".join(words)] = (words, {})
    model = f"openpi={ROOT}/models/openpi/model.py"
    asked[PREPARED] = (["worker", "openpi"], {plugins.OWN_ENVIRONMENT_VARIABLE: model})
    done = subprocess.run(
        [sys.executable, "-S", "-c", MANY],
        cwd=folder,
        env=alone,
        input=json.dumps([*asked.values()]),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(asked, (Said(*each) for each in json.loads(done.stdout)), strict=True))


def test_the_simulator_needs_no_plug_in(said: dict[str, Said]) -> None:
    done = said["profile check panda_sim"]
    assert done.code == 0, done.stderr


def test_a_robot_of_a_plug_in_is_named_with_what_is_installed(said: dict[str, Said]) -> None:
    done = said["profile check fr3"]
    assert done.code == 1
    assert "robot.driver: no robot driver 'franka' is installed" in done.stderr
    assert "Installed: arm, sim." in done.stderr
    assert said["profile show fr3"].code == 0


def test_the_doctor_needs_no_extra_and_lists_the_plug_ins(said: dict[str, Said]) -> None:
    done = said["doctor --json"]
    assert "cryptography" not in done.stderr
    found = {each["name"]: each["found"] for each in json.loads(done.stdout)}
    assert found["plug-ins: robot drivers"] == "arm, sim"
    assert found["plug-ins: benchmarks"] == "none"


def test_its_commands_are_listed_and_those_of_plug_ins_are_not(said: dict[str, Said]) -> None:
    done = said["node --help"]
    assert done.code == 0, done.stderr
    assert "  camera " in done.stdout
    assert "  rolling " not in done.stdout


SHARED = "the package vla-zenoh-policy-servers"
INSTALL = "install it with: pip install -c constraints.txt . './plugins/vla-zenoh-policy-servers'"


def test_a_model_whose_header_names_a_package_that_is_missing_says_how_to_install_it(
    said: dict[str, Said],
) -> None:
    done = said["worker openpi"]
    assert done.code == 1
    assert f"{SHARED} is not installed; {INSTALL}" in done.stderr
    assert "its environment lacks vla-zenoh-policy-servers" in said[PREPARED].stderr
    assert f"needs {SHARED}; {INSTALL}" in said[PREPARED].stderr


@pytest.mark.parametrize("name", ["scripted", "brick"])
def test_the_models_of_the_demo_need_no_package(alone: dict[str, str], name: str) -> None:
    """`check` ends its process itself."""
    done = subprocess.run(
        [sys.executable, "-S", "-m", "vla_zenoh", "check", name],
        env=alone,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_command_of_a_package_that_is_missing_says_how_to_install_it(
    said: dict[str, Said],
) -> None:
    for command, after in COMMANDS:
        line, package = " ".join([*command.split("."), *after]), plugins.PACKAGES[command]
        code, _, told = said[line]
        assert code == 1, (line, told)
        assert f"needs the package {package}; install it with: pip install" in told, line
        folders = [*plugins.needed_by(package), package]
        paths = " ".join(f"'./plugins/{each}'" for each in folders)
        assert f" . {paths} in a checkout" in told, line


def test_up_says_at_its_start_that_a_node_of_its_host_needs_a_package(
    said: dict[str, Said],
) -> None:
    done = said["up lab.yaml --dry-run"]
    assert done.code == 1
    assert "hosts.here.nodes has primitives: `vla-zenoh node primitives` needs" in done.stderr


@pytest.mark.realtime
def test_up_runs_without_a_rolling_record_and_names_its_package(
    alone: dict[str, str], tmp_path: Path
) -> None:
    router, small = free_endpoint(), tmp_path / "small.yaml"
    small.write_text(SMALL, "utf-8")
    words = ["up", str(small), "--dry-run", "--connect", router, "--listen", router]
    lines = []
    with subprocess.Popen(
        [sys.executable, "-S", "-m", "vla_zenoh", *words, "--log-dir", str(tmp_path)],
        env=alone,
        stdout=subprocess.PIPE,
        text=True,
    ) as lab:
        assert lab.stdout is not None
        for line in lab.stdout:
            lines.append(line)
            if "watch: " in line:
                lab.terminate()
    (sentence,) = [line for line in lines if "rolling record" in line]
    assert "`vla-zenoh node rolling` needs the package vla-zenoh-rolling; install" in sentence
    assert "all nodes have stopped" in lines[-1]
