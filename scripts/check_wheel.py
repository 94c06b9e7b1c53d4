"""Builds sdist and wheel, then tries each in an empty environment, away from the checkout."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from bootstrap import CONSTRAINTS, PLUGINS, ROOT, bring_openmp, uv_environment

DIST = ROOT / "dist"
UV = Path(sys.executable).parent / "uv"
LIMIT_S = 1200
"""Of a command, on a busy computer."""
ATTEMPTS = 3
"""Of a demo, which runs in real time: on a busy computer the arm may brake."""

LEFT_OUT = re.compile(r"training/|\.safetensors|benchmarks/|tests/|openvla/measure\.py|plugins/")
"""Of the wheel."""

TRIALS = [
    ["--help"],
    ["profile", "list"],
    ["demo", "--prompt", "HARD: go up x5", "--rate", "5", "--output", "runs", "--force"],
]


WITH_PLUGINS = [
    ["bench", "sim", "--help"],
    ["bench", "task", "--help"],
    ["compare", "--help"],
    ["do", "home", "--help"],
    ["figure", "motion", "--help"],
    ["profile", "check", "fr3", "ur5e_rtde"],
    ["view", "--help"],
    ["web", "--help"],
    ["node", "rolling", "--help"],
    ["node", "ros2", "--help"],
    ["nights", "--help"],
    ["trial", "--help"],
    ["conform", "robot", "--help"],
    ["replay", "--help"],
    ["secure", "show", "--help"],
    ["serve", "policy", "--help"],
    ["teleop", "--help"],
    ["dataset", "export", "--help"],
]


OF_PLUGINS = ("msgpack",)
"""What those commands import of what their packages require: all of it would be large."""


def run(*command: object, cwd: Path = ROOT, attempts: int = 1) -> None:
    """Runs a command and shows it; ends the program when all attempts fail."""
    words = [str(word) for word in command]
    print("+", " ".join(words), flush=True)
    environ = uv_environment(os.environ)
    # Nothing of the checkout may help the installed package.
    for name in ("PYTHONPATH", "VLA_ZENOH_PATH", "VIRTUAL_ENV"):
        environ.pop(name, None)
    for attempt in range(1, attempts + 1):
        try:
            done = subprocess.run(words, cwd=cwd, env=environ, check=False, timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            sys.exit(f"build: no end after {LIMIT_S} s: {' '.join(words)}")
        if not done.returncode:
            return
        load = os.getloadavg()[0]
        print(f"build: exit status {done.returncode} in attempt {attempt}, load {load:.1f}")
    sys.exit(f"build: exit status {done.returncode}: {' '.join(words)}")


def only(pattern: str) -> Path:
    """The one file in dist/ that fits `pattern`."""
    found = list(DIST.glob(pattern))
    if len(found) != 1:
        sys.exit(f"build: expected one {pattern} in {DIST}, found {len(found)}")
    return found[0]


def try_out(archive: Path, extra: str, plugins: Sequence[Path] = ()) -> None:
    """Installs `archive` into an empty environment and runs the command from an empty folder.

    Then it installs the wheels of `plugins` beside it, and runs what they bring.
    """
    with tempfile.TemporaryDirectory(prefix="vla-zenoh-build-") as name:
        folder = Path(name)
        work = folder / "work"
        work.mkdir()
        run(UV, "--quiet", "venv", "--python", sys.executable, folder / "venv")
        python = folder / "venv" / "bin" / "python"
        target = ["--python", python, "--constraint", CONSTRAINTS]
        run(UV, "--quiet", "pip", "install", *target, f"vla-zenoh[{extra}] @ {archive.as_uri()}")
        bring_openmp(UV, python)
        for trial in TRIALS:
            attempts = ATTEMPTS if trial[0] == "demo" else 1
            run(folder / "venv" / "bin" / "vla-zenoh", *trial, cwd=work, attempts=attempts)
        if not any((work / "runs").rglob("*")):
            sys.exit("build: the demo left nothing in the folder named with --output")
        if plugins:
            run(UV, "--quiet", "pip", "install", *target, "--no-deps", *plugins, *OF_PLUGINS)
        for trial in WITH_PLUGINS if plugins else ():
            run(folder / "venv" / "bin" / "vla-zenoh", *trial, cwd=work)


def main() -> None:
    """Builds, then tries wheel and sdist."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only-build", action="store_true", help="build, try nothing")
    options = parser.parse_args()
    shutil.rmtree(DIST, ignore_errors=True)
    # The wheel is made from the sdist, so a file missing there is missed here.
    run(UV, "--quiet", "build", "--out-dir", DIST, ROOT)
    for folder in PLUGINS:  # their version is that of the checkout
        run(UV, "--quiet", "build", "--wheel", "--out-dir", DIST, folder)
    wheel, sdist = only("vla_zenoh-*.whl"), only("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        surplus = [name for name in archive.namelist() if LEFT_OUT.search(name)]
    if surplus:
        sys.exit(f"build: the wheel contains unneeded files: {', '.join(surplus)}")
    print(f"build: {wheel.name} has {wheel.stat().st_size / 1e6:.2f} MB")
    if options.only_build:
        return
    try_out(wheel, "all", [only(f"{folder.name.replace('-', '_')}-*.whl") for folder in PLUGINS])
    try_out(sdist, "all")
    print(f"build: {wheel.name} and {sdist.name} work")


if __name__ == "__main__":
    main()
