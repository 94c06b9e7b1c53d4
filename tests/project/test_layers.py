"""Who may import whom: an order of folders, checked in the text and by importing."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from imports_in import imports_in

import vla_zenoh
from vla_zenoh import control

PACKAGE = Path(vla_zenoh.__file__).parent
ROOT = Path(__file__).parents[2]

ORDER = (
    # A folder, or a module beside them, imports those of the lines above and of its own line.
    ("errors",),
    ("keys", "opencv", "robot", "sanitize", "types"),
    ("plugins",),
    ("resources",),
    ("shipped",),
    ("policy",),
    ("profile",),
    ("codec",),
    ("kinematics",),
    ("control",),
    ("guard",),
    ("security", "simulation"),
    ("bus",),
    ("client",),
    ("runtime",),
    ("nodes",),
    ("robots",),
    ("cli",),
    ("lab",),
    ("program", "__main__"),
)
LEVEL = {room: level for level, rooms in enumerate(ORDER) for room in rooms}

IO = frozenset({"zenoh", "typer", "mujoco", "torch", "time", "threading", "asyncio"})
NODE = frozenset({"typer", "torch", "mujoco", "asyncio"})
ALLOWED = {
    # folder or file, the longest one counts: what of IO it may import
    "bus": IO - NODE,
    "client": IO - NODE,
    "runtime": IO - NODE,
    "nodes": IO - NODE,
    "robots": IO - NODE,
    "simulation": frozenset({"mujoco"}),
    "cli": IO - {"torch", "mujoco", "asyncio"},
    "program": IO - {"torch", "mujoco", "asyncio"},
    "__main__.py": IO - {"torch", "mujoco", "asyncio"},
    "lab/cli": IO - {"torch", "mujoco", "asyncio"},
    # What of the lab listens to a robot, drives it or starts processes.
    **dict.fromkeys(
        (
            "lab/check/model_runner.py",
            "lab/doctor/access.py",
            "lab/episode.py",
            "lab/newest_records.py",
            "lab/recording/recorder.py",
            "lab/recording/sample_queue.py",
            "lab/tasks/task_runner.py",
        ),
        IO - NODE,
    ),
}
HEAVY = ("zenoh", "typer", "torch", "mujoco", "matplotlib", "av", "pyarrow", "rerun")


def room(module: str) -> str:
    """Folder of a module of ours, or its own name where it lies beside them."""
    return module.split(".")[1]


def allowed(path: Path) -> frozenset[str]:
    steps = [path, *path.parents]
    return next((ALLOWED[str(step)] for step in steps if str(step) in ALLOWED), frozenset())


@cache
def imported_names(source: str) -> frozenset[str]:
    names: set[str] = set()
    for node in imports_in(source):
        before = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
        names.update(f"{before}{alias.name}" for alias in node.names)
    return frozenset(names)


def offences(source: str, forbidden: frozenset[str]) -> list[str]:
    return sorted(
        name
        for name in imported_names(source)
        if any(name == banned or name.startswith(f"{banned}.") for banned in forbidden)
    )


def test_where_the_tcp_may_be_is_read_in_one_place() -> None:
    """A further limit narrows `Limits.tcp_box`: who reads the workspace itself would miss it."""
    readers = {
        path.name
        for path in (*PACKAGE.rglob("*.py"), *(ROOT / "plugins").rglob("*.py"))
        if "limits.workspace" in (source := path.read_text())
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute) and ast.unparse(node).endswith("limits.workspace")
    }
    assert readers == set()


def test_the_map_of_control_has_every_module_once() -> None:
    shown = re.findall(r"^ *(\w+)  +\w", str(control.__doc__), re.M)
    assert sorted(shown) == sorted(
        path.stem for path in (PACKAGE / "control").glob("*.py") if path.stem != "__init__"
    )


OF_THE_PACKAGE = ("vla_zenoh.__version__", "vla_zenoh.lazy_names")
SOURCES = {path.relative_to(PACKAGE): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


def test_a_module_imports_only_what_its_layer_may() -> None:
    found = {path: offences(source, IO - allowed(path)) for path, source in SOURCES.items()}
    assert {path: names for path, names in found.items() if names} == {}


def test_a_module_imports_no_folder_above_its_own() -> None:
    above = [
        (path, name)
        for path, source in SOURCES.items()
        if (here := path.parts[0].removesuffix(".py")) != "__init__"
        for name in imported_names(source)
        if name.startswith("vla_zenoh.") and name not in OF_THE_PACKAGE
        if LEVEL[room(name)] > LEVEL[here]
    ]
    assert above == []


OUTSIDE = ("lab", "program", "__main__")
"""What is not the core: the lab, and the program that has commands of both."""
OF_THE_LAB = re.compile(r"(vla_zenoh\.)?lab\.[A-Za-z_.]+(:[a-z_]+)?")


def names_of_the_lab(source: str) -> set[str]:
    """Modules of the lab that a file imports, or names in a string for a later import."""
    texts = {
        node.value
        for node in (ast.walk(ast.parse(source)) if "lab." in source else ())
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    return {name for name in texts | imported_names(source) if OF_THE_LAB.fullmatch(name)}


def test_no_module_of_the_core_imports_the_lab_at_any_time() -> None:
    found = {
        path: names_of_the_lab(source)
        for path, source in SOURCES.items()
        if path.parts[0].removesuffix(".py") not in OUTSIDE
    }
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "source",
    [
        "from vla_zenoh.lab.doctor import HostFinding",
        "def f():\n    import vla_zenoh.lab.tasks",
        "TABLE = {'check': 'lab.cli.check:check'}",
        "import_module('vla_zenoh.lab.check')",
    ],
)
def test_every_way_to_import_the_lab_is_seen(source: str) -> None:
    assert names_of_the_lab(source)


def test_connecting_and_the_nodes_load_nothing_of_the_lab() -> None:
    nodes = "nodes.camera.node, nodes.worker.node, nodes.command.node, robots.node, cli.up"
    modules = ", ".join(f"vla_zenoh.{name}" for name in nodes.split(", "))
    loaded = loaded_after(f"vla_zenoh, {modules}; vla_zenoh.connect")
    assert not any(name.startswith("vla_zenoh.lab") for name in loaded)


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Imports for types alone count."""
    modules = {module_name(path): path for path in SOURCES}
    waiting = {
        name: {
            found
            for imported in imported_names(SOURCES[path])
            if (found := imported if imported in modules else imported.rpartition(".")[0])
            in modules
        }
        - {name, "vla_zenoh"}
        for name, path in modules.items()
    }
    while free := {name for name, needed in waiting.items() if not needed & waiting.keys()}:
        waiting = {name: needed for name, needed in waiting.items() if name not in free}
    while outer := waiting.keys() - {name for needed in waiting.values() for name in needed}:
        waiting = {name: needed for name, needed in waiting.items() if name not in outer}
    assert sorted(waiting) == []


def module_name(path: Path) -> str:
    parts = ("vla_zenoh", *path.with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_every_folder_has_its_place_in_the_order() -> None:
    rooms = {path.parts[0].removesuffix(".py") for path in SOURCES} - {"__init__"}
    assert rooms == LEVEL.keys()


def test_imports_inside_functions_and_of_parts_are_seen() -> None:
    source = "def f():\n    from zenoh import Session\n    import time.x as s\n"
    assert offences(source, IO) == ["time.x", "zenoh.Session"]


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
    outer = ("bus", "client", "runtime", "nodes", "robots", "cli", "program", "simulation")
    core = [name for name in beside + folders if name not in outer]
    return sorted(core)


def test_importing_the_core_loads_nothing_heavy() -> None:
    loaded = loaded_after(", ".join(f"vla_zenoh.{name}" for name in core_modules()))
    assert loaded.intersection(HEAVY) == set()


def test_doctor_starts_where_opencv_does_not_load() -> None:
    assert loaded_after("vla_zenoh.lab.cli.doctor").isdisjoint({"cv2"})


def test_importing_what_adapters_share_loads_nothing_that_their_environments_lack() -> None:
    loaded = loaded_after("vla_zenoh_policy_servers.adapter")
    assert loaded.isdisjoint({*HEAVY, *OPTIONAL, "cv2", "rosbags"})


def test_what_drives_a_robot_or_serves_a_model_loads_no_opencv() -> None:
    nodes = "vla_zenoh.nodes.command.node, vla_zenoh.nodes.worker.node, vla_zenoh.robots.arm"
    assert loaded_after(f"{nodes}, vla_zenoh.client, vla_zenoh.lab.cli.check").isdisjoint({"cv2"})


def test_importing_the_package_loads_no_library_at_all() -> None:
    assert loaded_after("vla_zenoh").isdisjoint({*HEAVY, "numpy", "cv2", "pydantic", "pinocchio"})


OPTIONAL = (
    "pinocchio",
    "ruckig",
    "daqp",
    "mujoco",
    "matplotlib",
    "av",
    "cv2",
    "flask",
    "zmq",
    "websockets",
    "rerun",
    "starlette",
    "uvicorn",
    "prometheus_client",
)


def test_the_command_line_knows_every_command_without_any_optional_library() -> None:
    """A model's environment has what the package itself needs, and no more."""
    code = (
        f"import sys\nfor name in {OPTIONAL!r}: sys.modules[name] = None\n"
        "import typer, vla_zenoh.program.main as main\n"
        "for name, found in typer.main.get_command(main.app).commands.items():\n"
        "    assert found.name == name and found.help, name"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_a_command_that_is_not_called_is_not_imported() -> None:
    """Every node and every word of a person waits for the import of the command line."""
    loaded = loaded_after("vla_zenoh.program.main")
    assert {name for name in loaded if name.startswith("vla_zenoh.cli.")} == {
        "vla_zenoh.cli.options"
    }
    assert not any(name.startswith("vla_zenoh.lab") for name in loaded)
    assert loaded.isdisjoint({"numpy", "pydantic", "vla_zenoh.nodes"})
