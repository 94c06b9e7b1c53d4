"""The package works where none of the packages in plugins/ is installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

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


def run(alone: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    """Run ``vla-zenoh`` there."""
    return subprocess.run(
        [sys.executable, "-S", "-m", "vla_zenoh", *words],
        env=alone,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_simulator_needs_no_plug_in(alone: dict[str, str]) -> None:
    done = run(alone, "profile", "check", "panda_sim")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("profile", "driver"), [("fr3", "franka"), ("panda_ros2", "ros2")])
def test_a_robot_of_a_plug_in_is_named_with_what_is_installed(
    alone: dict[str, str], profile: str, driver: str
) -> None:
    done = run(alone, "profile", "check", profile)
    assert done.returncode == 1
    assert f"robot.driver: no robot driver '{driver}' is installed" in done.stderr
    assert "Installed: arm, sim." in done.stderr
    assert run(alone, "profile", "show", profile).returncode == 0


def test_the_doctor_needs_no_extra_and_lists_the_plug_ins(alone: dict[str, str]) -> None:
    done = run(alone, "doctor", "--json")
    assert "cryptography" not in done.stderr
    found = {each["name"]: each["found"] for each in json.loads(done.stdout)}
    assert found["plug-ins: robot drivers"] == "arm, sim"
    assert found["plug-ins: benchmarks"] == "none"


def test_its_commands_are_listed_and_those_of_plug_ins_are_not(alone: dict[str, str]) -> None:
    done = run(alone, "node", "--help")
    assert done.returncode == 0, done.stderr
    assert "  camera " in done.stdout
    assert "  rolling " not in done.stdout


SHARED = "the package vla-zenoh-policy-servers"
INSTALL = "install it with: pip install -c constraints.txt . './plugins/vla-zenoh-policy-servers'"


def test_a_model_whose_header_names_a_package_that_is_missing_says_how_to_install_it(
    alone: dict[str, str],
) -> None:
    done = run(alone, "worker", "openpi")
    assert done.returncode == 1
    assert f"{SHARED} is not installed; {INSTALL}" in done.stderr
    prepared = {**alone, plugins.OWN_ENVIRONMENT_VARIABLE: f"openpi={ROOT}/models/openpi/model.py"}
    done = run(prepared, "worker", "openpi")
    assert "its environment lacks vla-zenoh-policy-servers" in done.stderr
    assert f"needs {SHARED}; {INSTALL}" in done.stderr


def test_the_models_of_the_demo_need_no_package(alone: dict[str, str]) -> None:
    for name in ("scripted", "brick"):
        done = run(alone, "check", name)
        assert done.returncode == 0, done.stderr


MANY = """
import contextlib, io, json, sys
from vla_zenoh.program.entry import main

told = []
for words in json.load(sys.stdin):
    sys.argv, said, code = ["vla-zenoh", *words], io.StringIO(), 0
    with contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as end:
            code = end.code
    told.append((code, said.getvalue()))
json.dump(told, sys.stdout)
"""
AFTER = ((), ("--help",), ("a-word", "--an-option=1"))


def test_a_command_of_a_package_that_is_missing_says_how_to_install_it(
    alone: dict[str, str],
) -> None:
    """One process runs them all: each would spend its time on the same imports."""
    asked = [(command, after) for command in plugins.PACKAGES for after in AFTER]
    words = [(*command.split("."), *after) for command, after in asked]
    done = subprocess.run(
        [sys.executable, "-S", "-c", MANY],
        env=alone,
        input=json.dumps(words),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for (command, after), (code, said) in zip(asked, json.loads(done.stdout), strict=True):
        assert code == 1, (command, after, said)
        package = plugins.PACKAGES[command]
        assert f"needs the package {package}; install it with: pip install" in said, after
        folders = [*plugins.needed_by(package), package]
        paths = " ".join(f"'./plugins/{each}'" for each in folders)
        assert f" . {paths} in a checkout" in said, (command, after)


def test_up_says_at_its_start_that_a_node_of_its_host_needs_a_package(
    alone: dict[str, str], tmp_path: Path
) -> None:
    profile = tmp_path / "lab.yaml"
    nodes = "[router, sim, camera, command, worker, primitives]"
    profile.write_text(f"extends: panda_sim\nhosts: {{here: {{nodes: {nodes}}}}}\n", "utf-8")
    done = run(alone, "up", str(profile), "--dry-run")
    assert done.returncode == 1
    assert "hosts.here.nodes has primitives: `vla-zenoh node primitives` needs" in done.stderr


@pytest.mark.realtime
def test_up_runs_without_a_rolling_record_and_names_its_package(
    alone: dict[str, str], tmp_path: Path
) -> None:
    router = free_endpoint()
    words = ["up", "panda_sim", "--dry-run", "--connect", router, "--listen", router]
    said = []
    with subprocess.Popen(
        [sys.executable, "-S", "-m", "vla_zenoh", *words, "--log-dir", str(tmp_path)],
        env=alone,
        stdout=subprocess.PIPE,
        text=True,
    ) as lab:
        assert lab.stdout is not None
        for line in lab.stdout:
            said.append(line)
            if "watch: " in line:
                lab.terminate()
    (sentence,) = [line for line in said if "rolling record" in line]
    assert "`vla-zenoh node rolling` needs the package vla-zenoh-rolling; install" in sentence
    assert "all nodes have stopped" in said[-1]
