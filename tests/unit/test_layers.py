"""Who may import whom: core <- nodes <- cli, checked in the text and by importing."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import vla_zenoh

PACKAGE = Path(vla_zenoh.__file__).parent

OUTER = frozenset({"vla_zenoh.nodes", "vla_zenoh.cli"})
PURE = frozenset({"zenoh", "typer", "mujoco", "torch", "time", "threading", "asyncio"}) | OUTER

FORBIDDEN = {
    # folder, or "." for the modules beside them: what nothing in it may import
    ".": PURE,
    "bench": PURE - {"asyncio"},  # openpi's server is one of asyncio
    "check": PURE,
    "codec": PURE,
    "dataset": PURE,
    "lockstep": PURE,
    "types": PURE,
    "control": PURE,
    "evaluation": PURE,
    "interop": PURE,
    "profile": PURE,
    "recording": PURE,
    "security": PURE,
    "simulation": PURE - {"mujoco"},
    "tasks": PURE,
    "teleop": PURE,
    "view": PURE,
    "demo": PURE,
    "doctor": PURE,
    "nodes": frozenset({"typer", "torch", "mujoco", "asyncio", "vla_zenoh.cli"}),
    "cli": frozenset({"torch", "mujoco", "asyncio"}),
}
HEAVY = ("zenoh", "typer", "torch", "mujoco", "matplotlib", "av", "pyarrow", "rerun")


def room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    if parts == ("__main__.py",):
        return "cli"
    return parts[0] if len(parts) > 1 else "."


def imported_names(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def offences(source: str, forbidden: frozenset[str]) -> list[str]:
    return sorted(
        name
        for name in imported_names(source)
        if any(name == banned or name.startswith(f"{banned}.") for banned in forbidden)
    )


SOURCES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_a_module_imports_only_what_its_layer_may(path: Path) -> None:
    assert offences((PACKAGE / path).read_text(), FORBIDDEN[room(PACKAGE / path)]) == []


def test_imports_inside_functions_and_of_parts_are_seen() -> None:
    source = "def f():\n    from zenoh import Session\n    import vla_zenoh.nodes.session as s\n"
    assert offences(source, PURE) == ["vla_zenoh.nodes.session", "zenoh.Session"]


def loaded_after(module: str) -> set[str]:
    code = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def core_modules() -> list[str]:
    beside = [path.stem for path in PACKAGE.glob("*.py") if not path.stem.startswith("__")]
    folders = [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    core = [name for name in beside + folders if name not in ("nodes", "cli", "simulation")]
    return sorted(core)


@pytest.mark.parametrize("name", core_modules())
def test_importing_the_core_loads_nothing_heavy(name: str) -> None:
    assert loaded_after(f"vla_zenoh.{name}").isdisjoint(HEAVY)


def test_importing_the_package_loads_no_library_at_all() -> None:
    assert loaded_after("vla_zenoh").isdisjoint({*HEAVY, "numpy", "cv2", "pydantic", "pinocchio"})


OPTIONAL = (
    "pinocchio",
    "ruckig",
    "mujoco",
    "matplotlib",
    "av",
    "flask",
    "zmq",
    "websockets",
    "rerun",
)


def test_the_command_line_knows_every_command_without_any_optional_library() -> None:
    """A model's environment has what the package itself needs, and no more."""
    code = (
        f"import sys\nfor name in {OPTIONAL!r}: sys.modules[name] = None\n"
        "import typer, vla_zenoh.cli.main as main\n"
        "for name, found in typer.main.get_command(main.app).commands.items():\n"
        "    assert found.name == name and found.help, name"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_a_command_that_is_not_called_is_not_imported() -> None:
    """Every node and every word of a person waits for the import of the command line."""
    loaded = loaded_after("vla_zenoh.cli.main")
    assert {name for name in loaded if name.startswith("vla_zenoh.cli.")} == {
        "vla_zenoh.cli.lazy",
        "vla_zenoh.cli.main",
    }
    assert loaded.isdisjoint({"numpy", "pydantic", "vla_zenoh.nodes"})
