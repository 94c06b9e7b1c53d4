"""How large the package is, and how much of it a reader has to open.

    python scripts/house.py [--src FOLDER] [--trace] [--json]

For each folder of ``src/vla_zenoh``: files, lines and tokens (Python's, without comments,
docstrings, indentation and line ends). For the whole: tokens of all tracked Python by top folder,
modules that Python loads for the four nodes of a simulated robot (where the package can be
imported), constants of ``control`` and ``guard`` and their conditions on poses or joints, import
cycles (imports for types count), and class names that occur twice. ``--trace`` adds the files that
run between an image and a motion: it starts the nodes, lets a model that needs a camera move the
arm, and records which functions are called meanwhile.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tokenize
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "vla_zenoh"
NODES = (
    # today, and as they were called before there were rooms
    ("nodes.camera.node", "nodes.camera"),
    ("nodes.worker.node", "nodes.worker"),
    ("nodes.command.node", "nodes.command"),
    ("robots.sim_driver", "nodes.sim"),
)
LAB, FRONT = "lab", ("lab", "cli")
MOTION = ("control", "guard")
OF_SPACE = re.compile(
    r"\b(in_joints|JointGoal|Joint(Path|Command|Reference)|PoseCommand|joint_bounds|_joint_steps"
    r"|_path|bounds is|bounds is not|mode [!=]=)\b|\.(space|command|arm)\b"
    r"|joints(_rad)? is (not )?None"
)
"""In a condition: it asks whether a motion is of poses or of joints."""
PROGRAMS = ("router", "sim", "camera", "worker", "command")
NOT_COUNTED = {
    tokenize.COMMENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
    tokenize.INDENT,
    tokenize.NEWLINE,
    tokenize.NL,
}
START_S, MOVING_S, END_S, KEEP_S = 60.0, 4.0, 10.0, 0.5
MODEL = """
# /// script
# dependencies = []
# ///
from vla_zenoh.policy import ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec


class Policy:
    spec = ModelSpec(
        name="look",
        observation=ObservationSpec(
            cameras=(CameraSpec(camera="front", width=224, height=224, resize="pad"),)
        ),
        action=ActionSpec(horizon=1, dt_s=0.2, rotation="rpy", gripper="none"),
    )

    def infer(self, observation):
        assert observation.images["front"].any()
        return ActionSteps([[0, 0, 0.005, 0, 0, 0]])
"""


def modules_in(src: Path) -> dict[str, Path]:
    """Name -> file of every module of the package."""
    found = {}
    for path in sorted((src / PACKAGE).rglob("*.py")):
        parts = path.relative_to(src).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def tokens_in(path: Path) -> int:
    """Tokens of a file, without comments, docstrings, indentation and line ends."""
    docstrings = {
        (node.lineno, node.col_offset)
        for node in ast.walk(ast.parse(path.read_bytes()))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }
    with path.open("rb") as file:
        return sum(
            token.type not in NOT_COUNTED and token.start not in docstrings
            for token in tokenize.tokenize(file.readline)
        )


def tokens_by_top_folder(root: Path) -> dict[str, int]:
    """Top folder -> tokens of the Python files that git tracks below it."""
    listed = subprocess.run(
        ["git", "-C", root, "ls-files", "-z", "*.py"], capture_output=True, text=True, check=True
    )
    tokens: Counter[str] = Counter()
    for name in filter(None, listed.stdout.split("\0")):
        if (root / name).is_file():
            tokens[Path(name).parts[0]] += tokens_in(root / name)
    return dict(tokens)


def imports_of(modules: dict[str, Path]) -> dict[str, set[str]]:
    """Module -> the modules of the package that it imports, at whatever place."""
    out: dict[str, set[str]] = {}
    for name, path in modules.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    found.add(whole if whole in modules else node.module)
        out[name] = (found & modules.keys()) - {name}
    return out


def loaded_by(src: Path, names: list[str], modules: dict[str, Path]) -> list[str] | None:
    """Modules of the package that Python has loaded when it has imported `names`; None if it cannot
    import them.

    Packages whose file is a docstring and no more do not count.
    """
    code = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)\n"
    code += "print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, *names],
        env={**os.environ, "PYTHONPATH": str(src)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1]
        print(
            f"modules of the nodes are not counted: {sys.executable} cannot import them ({why}); "
            "`make setup`, then .venv/bin/python scripts/house.py",
            file=sys.stderr,
        )
        return None
    loaded = [name for name in done.stdout.split() if name in modules]
    return [name for name in loaded if not says_nothing(modules[name])]


def in_cycles(imports: dict[str, set[str]]) -> list[str]:
    """Modules that import themselves by way of others."""
    left = {name: needed - {PACKAGE} for name, needed in imports.items()}
    while True:
        needed = {target for targets in left.values() for target in targets}
        out = {name for name, targets in left.items() if not targets & left.keys()}
        out |= left.keys() - needed
        if not out:
            return sorted(left)
        left = {name: targets for name, targets in left.items() if name not in out}


def class_names_twice(modules: dict[str, Path]) -> dict[str, list[str]]:
    """Class name -> modules, where there is more than one; private ones do not count."""
    found = defaultdict(list)
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(name.removeprefix(f"{PACKAGE}."))
    return {name: where for name, where in sorted(found.items()) if len(where) > 1}


def says_nothing(path: Path) -> bool:
    """Whether a file is a docstring and no more, as that of most packages."""
    body = ast.parse(path.read_text("utf-8")).body
    return all(isinstance(node, ast.Expr) for node in body)


def constants_in(path: Path) -> list[str]:
    """Names in capitals that a module assigns."""
    return [
        node.id
        for statement in ast.parse(path.read_text("utf-8")).body
        for target in getattr(statement, "targets", [getattr(statement, "target", None)])
        if target is not None
        for node in ast.walk(target)
        if isinstance(node, ast.Name) and node.id.isupper()
    ]


def branches_on_space(path: Path) -> int:
    """Conditions that ask whether a motion is of poses or of joints."""
    return sum(
        OF_SPACE.search(ast.unparse(node.test)) is not None
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert)
    )


def measure(src: Path) -> dict[str, Any]:
    """Everything that needs no process."""
    modules = modules_in(src)
    imports = imports_of(modules)
    lines = {name: len(path.read_text("utf-8").splitlines()) for name, path in modules.items()}
    files: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    tokens: Counter[str] = Counter()
    for name, path in modules.items():
        parts = path.relative_to(src / PACKAGE).parts
        room = parts[0] if len(parts) > 1 else "(beside them)"
        files[room] += 1
        sizes[room] += lines[name]
        tokens[room] += tokens_in(path)
    motion = [path for folder in MOTION for path in sorted((src / PACKAGE / folder).glob("*.py"))]
    roots = [f"{PACKAGE}.{name}" for names in NODES for name in names]
    present = [name for name in roots if name in modules and modules[name].name != "__init__.py"]
    loaded = loaded_by(src, present, modules)
    tops = tokens_by_top_folder(src.parent)
    return {
        "rooms": {room: [files[room], sizes[room], tokens[room]] for room in sorted(files)},
        "files": len(modules),
        "lines": sum(lines.values()),
        "core_lines": sum(sizes.values()) - sizes[LAB],
        "tokens": sum(tokens.values()),
        "core_tokens": sum(tokens.values()) - tokens[LAB],
        "tokens_by_top_folder": tops,
        "tokens_outside_tests": sum(tops.values()) - tops.get("tests", 0),
        "node_modules": None if loaded is None else len(loaded),
        "node_lines": None if loaded is None else sum(lines[name] for name in loaded),
        "motion_constants": sum(len(constants_in(path)) for path in motion),
        "motion_branches": sum(map(branches_on_space, motion)),
        "cycles": in_cycles(imports),
        "class_names_twice": class_names_twice(modules),
    }


def traced_program(out: Path, arguments: list[str]) -> None:
    """Run ``vla-zenoh`` with `arguments`, and write when each file's code was last called."""
    import threading

    last: dict[str, float] = {}

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call":
            last[frame.f_code.co_filename] = time.time()

    def keep() -> None:
        while True:  # a node may end without unwinding
            time.sleep(KEEP_S)
            beside = out.with_suffix(".part")
            beside.write_text(json.dumps(dict(last)), "utf-8")
            beside.replace(out)

    threading.Thread(target=keep, daemon=True).start()
    threading.setprofile(note)
    sys.setprofile(note)
    from vla_zenoh.program.entry import main

    sys.argv = ["vla-zenoh", *arguments]
    main()


def answers(address: tuple[str, int]) -> bool:
    """Whether a server listens there."""
    try:
        socket.create_connection(address).close()
    except OSError:
        return False
    return True


def trace(src: Path) -> list[str]:
    """Files of the package that run while images become motions, command line and lab aside."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            address = probe.getsockname()
        endpoint = f"tcp/127.0.0.1:{address[1]}"
        (folder / "look.py").write_text(MODEL, "utf-8")
        profile = folder / "traced.yaml"
        session = f"session: {{listen: [{endpoint}], connect: [{endpoint}]}}\n"
        profile.write_text(
            "extends: panda_sim\nworkers: [look]\nmodels: {look: look.py}\n"
            "task: {worker: look, prompt: go, rate_hz: 5}\n" + session,
            "utf-8",
        )
        environment = {**os.environ, "PYTHONPATH": str(src)}

        def command(*words: str) -> list[str]:
            return [sys.executable, "-m", PACKAGE, *words, "--profile", str(profile)]

        programs = []
        for program in PROGRAMS:
            word = ["worker", "look"] if program == "worker" else ["node", program]
            words = [*word, "--profile", str(profile)]
            whole = [sys.executable, __file__, "--as", str(folder / f"{program}.json"), *words]
            programs.append(subprocess.Popen(whole, env=environment, cwd=folder))
            while program == "router" and not answers(address):
                time.sleep(0.1)  # the others do not wait for it
        try:
            give_up = time.monotonic() + START_S
            while subprocess.run(command("activate"), env=environment, check=False).returncode:
                if time.monotonic() > give_up:
                    raise SystemExit("the nodes are not ready")
                time.sleep(0.5)
            begun = time.time() + 1.0
            time.sleep(1.0 + MOVING_S + 2 * KEEP_S)
            # Before they are stopped: what stops a node does not move an arm.
            ran = [
                json.loads((folder / f"{program}.json").read_text("utf-8"))
                for program in PROGRAMS[1:]
            ]
        finally:
            for process in reversed(programs):
                process.send_signal(signal.SIGINT)
            for process in programs:
                process.wait(END_S)
        called = {file for last in ran for file, at in last.items() if at >= begun}
    inside = sorted(Path(file) for file in called if Path(file).is_relative_to(src / PACKAGE))
    names = [path.relative_to(src / PACKAGE) for path in inside]
    return [
        str(name) for name in names if name.parts[0] not in FRONT and name.name != "__init__.py"
    ]


def show(found: dict[str, Any]) -> None:
    """A table of Markdown."""
    print("| room | files | lines | tokens |\n|---|---|---|---|")
    for room, (files, lines, tokens) in found["rooms"].items():
        print(f"| {room} | {files} | {lines} | {tokens} |")
    print(f"| **all** | {found['files']} | {found['lines']} | {found['tokens']} |\n")
    print(f"outside {LAB}/: {found['core_lines']} lines, {found['core_tokens']} tokens")
    print(f"tokens a line: {found['tokens'] / found['lines']:.1f}")
    tops = ", ".join(f"{name} {count}" for name, count in found["tokens_by_top_folder"].items())
    print(f"tokens of all tracked Python: {tops}")
    print(f"tokens outside tests/: {found['tokens_outside_tests']}")
    if found["node_modules"] is not None:
        print(f"modules that the four nodes import: {found['node_modules']}", end="")
        print(f" ({found['node_lines']} lines)")
    if "trace" in found:
        print(f"files that run between an image and a motion: {len(found['trace'])}")
        print("  " + " ".join(found["trace"]))
    print(f"control/ and guard/: {found['motion_constants']} constants, ", end="")
    print(f"{found['motion_branches']} branches on the space")
    print(f"modules in cycles: {len(found['cycles'])} {' '.join(found['cycles'])}".rstrip())
    twice = found["class_names_twice"]
    print(f"class names that occur twice: {len(twice)}")
    for name, where in twice.items():
        print(f"  {name}: {', '.join(where)}")


def main() -> None:
    """Measure and show."""
    if sys.argv[1:2] == ["--as"]:
        traced_program(Path(sys.argv[2]), sys.argv[3:])
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--src", type=Path, default=ROOT / "src", help="of another checkout")
    parser.add_argument("--trace", action="store_true", help="start the nodes, too")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    src = arguments.src.resolve()
    found = measure(src)
    if arguments.trace:
        found["trace"] = trace(src)
    if arguments.json:
        print(json.dumps(found, indent=2))
    else:
        show(found)


if __name__ == "__main__":
    main()
