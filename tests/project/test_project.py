"""The project's own files agree with each other, and set-up obeys what pip was told."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from imports_in import imports_in

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ["benchmarks", "examples", "models", "plugins", "reliability", "scripts", "sim", "tests"]
TARGETS = ("setup", "demo", "test", "check", "bench", "build", "clean")


@pytest.fixture(scope="module")
def bootstrap() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bootstrap", ROOT / "scripts" / "bootstrap.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def name_of(requirement: str) -> str:
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert match is not None
    return match[0].lower().replace("_", "-")


def pinned() -> set[str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert all(re.fullmatch(r"[a-z0-9.-]+==[0-9][\w.]*( ; [^/]+)?", line) for line in lines), (
        "constraints.txt holds names and versions only"
    )
    return {name_of(line) for line in lines}


def test_every_library_of_the_usual_installation_is_pinned(project: dict) -> None:
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["control"] + extras["sim"] + extras["dev"]
    assert {name_of(line) for line in wanted} - {"vla-zenoh"} <= pinned()


def test_torch_comes_only_when_asked_for(project: dict) -> None:
    assert "torch" not in pinned()
    assert not any("torch" in line for line in project["optional-dependencies"]["all"])


def test_a_camera_host_gets_no_simulator_and_no_kinematics(project: dict) -> None:
    heavy = {"pin", "ruckig", "daqp", "mujoco", "mujoco-core", "torch", "matplotlib", "av"}
    assert heavy.isdisjoint(map(name_of, project["dependencies"]))


def test_a_set_up_has_the_packages_that_its_extras_ask_for(bootstrap: ModuleType) -> None:
    everything = {path.name for path in bootstrap.plugins_of(bootstrap.EVERYTHING)}
    assert {bootstrap.LARGE, "vla-zenoh-web"} <= everything
    tutorial = {path.name for path in bootstrap.plugins_of("all")}
    assert everything - tutorial == {bootstrap.LARGE}
    assert not bootstrap.plugins_of("brick,sim")


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_alone_lists_the_targets() -> None:
    done = subprocess.run(["make"], cwd=ROOT, capture_output=True, text=True, check=True)
    for target in TARGETS:
        assert re.search(rf"^  make {target}\s+\w", done.stdout, re.MULTILINE), target


def test_ci_runs_what_people_run() -> None:
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    assert "make check test test-ros2 test-franka build" in lines
    assert lines[-1].startswith("make soak MINUTES=2 ")


def test_what_is_imported_from_the_package_is_there() -> None:
    """Of programs that no other test starts, and of models in environments of their own, too."""
    wrong = []
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*.py"):
            wrong += [
                f"{path.relative_to(ROOT)}:{node.lineno}: {node.module}.{alias.name}"
                for node in imports_in(path.read_text())
                if isinstance(node, ast.ImportFrom)
                if node.module and node.module.startswith("vla_zenoh.")
                for alias in node.names
                if not is_there(node.module, alias.name)
            ]
    assert not wrong, wrong


def is_there(module: str, name: str) -> bool:
    try:
        if hasattr(importlib.import_module(module), name):
            return True
        importlib.import_module(f"{module}.{name}")
    except ModuleNotFoundError as error:
        # A library of an extra that is not installed says nothing about the name.
        return not (error.name or "").startswith("vla_zenoh")
    return True


def test_what_pip_was_told_is_said_to_uv(bootstrap: ModuleType, tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    environ = {
        "HOME": str(tmp_path),
        "PIP_CONFIG_FILE": str(tmp_path / "none"),
        "PIP_INDEX_URL": "https://packages.example/simple",
        "PIP_EXTRA_INDEX_URL": "https://one.example/simple https://two.example/simple",
        "PIP_FIND_LINKS": f"{wheels} {tmp_path / 'absent'} https://wheels.example",
        "PIP_CERT": "/etc/lab.pem",
        "PIP_TRUSTED_HOST": "index.example",
        "PIP_DEFAULT_TIMEOUT": "90",
    }
    told = bootstrap.uv_environment(environ)
    assert told["UV_DEFAULT_INDEX"] == "https://packages.example/simple"
    assert told["UV_INDEX"] == "https://one.example/simple https://two.example/simple"
    assert told["UV_FIND_LINKS"] == f"{wheels},https://wheels.example"
    assert told["SSL_CERT_FILE"] == "/etc/lab.pem"
    assert told["UV_INSECURE_HOST"] == "index.example"
    assert told["UV_HTTP_TIMEOUT"] == "90"
    assert told["UV_INDEX_STRATEGY"] == "unsafe-best-match"


def test_what_uv_was_told_itself_stays(bootstrap: ModuleType) -> None:
    environ = {"PIP_INDEX_URL": "https://a.example", "UV_DEFAULT_INDEX": "https://b.example"}
    assert bootstrap.uv_environment(environ)["UV_DEFAULT_INDEX"] == "https://b.example"


def test_the_files_of_pip_are_read_and_its_variables_win(
    bootstrap: ModuleType, tmp_path: Path
) -> None:
    folder = tmp_path / ".config" / "pip"
    folder.mkdir(parents=True)
    (folder / "pip.conf").write_text(
        "[global]\nindex-url = https://file.example/%25\n[install]\nextra-index-url =\n"
        "    https://one.example\n    https://two.example\n"
    )
    told = bootstrap.uv_environment({"HOME": str(tmp_path)})
    assert told["UV_DEFAULT_INDEX"] == "https://file.example/%25"
    assert told["UV_INDEX"] == "https://one.example https://two.example"
    told = bootstrap.uv_environment({"HOME": str(tmp_path), "PIP_INDEX_URL": "https://v.example"})
    assert told["UV_DEFAULT_INDEX"] == "https://v.example"


def test_without_uv_venv_and_pip_the_debian_package_is_named(bootstrap: ModuleType) -> None:
    code = (
        "import importlib.util, runpy, sys\n"
        "real = importlib.util.find_spec\n"
        "hidden = ('pip', 'ensurepip')\n"
        "importlib.util.find_spec = lambda name, *rest: None if name in hidden else real(name)\n"
        "script = runpy.run_path(sys.argv[1])\n"
        "print(script['missing_packages'](has_uv=False))\n"
    )
    script = str(ROOT / "scripts" / "bootstrap.py")
    done = subprocess.run(
        [sys.executable, "-c", code, script], capture_output=True, text=True, check=True
    )
    assert "python3-venv" in done.stdout
    assert "python3-venv" not in bootstrap.missing_packages(has_uv=True)


def test_an_old_python_is_told_what_to_do(bootstrap: ModuleType) -> None:
    code = (
        "import runpy, sys\n"
        "sys.version_info = (3, 9, 2)\n"
        "runpy.run_path(sys.argv[1], run_name='__main__')\n"
    )
    script = str(ROOT / "scripts" / "bootstrap.py")
    done = subprocess.run(
        [sys.executable, "-c", code, script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "Python 3.11 or newer is needed, this is 3.9" in done.stderr
    assert "make setup PYTHON=" in done.stderr


def test_the_graph_of_the_policy_does_not_tell_on_whose_computer_it_was_made() -> None:
    graph = (ROOT / "models" / "brick" / "brick.onnx").read_bytes()
    assert b"site-packages" not in graph
    assert b'.py"' not in graph


def test_no_two_files_of_tests_have_one_name() -> None:
    """Of those that run together: pytest imports them by it."""
    apart = {"models", "rivals"}
    files = [
        path.name
        for path in (ROOT / "tests").rglob("test_*.py")
        if not apart & set(path.relative_to(ROOT).parts)
    ]
    assert [name for name in sorted(set(files)) if files.count(name) > 1] == []
