"""Tests of the driver franka against franka-sim, which uv gives an environment of its own.

    .venv/bin/python scripts/test_franka.py [PYTEST OPTIONS]
    .venv/bin/python scripts/test_franka.py --benchmark [NAME ...]   # benchmarks/franka instead

The simulator pins an older numpy and MuJoCo than this package uses. The driver's library, franky,
is the extra ``franky`` of plugins/vla-zenoh-franka, and is installed into ./.venv.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

from bootstrap import uv_environment

ROOT = Path(__file__).resolve().parent.parent
SIMULATOR = "FRANKA_SIM"
CONTESTANTS = {
    "FRANKA_RS": ("franka-rs==0.4.0", "numpy"),
    "AIOFRANKA": ("aiofranka==0.3.0", "pylibfranka==0.21.3", "mujoco<3.3"),
}
"""Environment variable -> packages of a library that the benchmark compares."""
PACKAGES = ("franka-sim==1.1.7", "aiofranka==0.3.0")
"""aiofranka carries a model of the FR3 with meshes; franka-sim would download one."""


def environment(uv: str, environ: dict[str, str], *packages: str) -> str:
    """Make an environment with `packages`; the command that runs its Python."""
    command = [uv, "--quiet", "run", "--no-project", "--isolated", "--python", "3.11"]
    for package in packages:
        command += ["--with", package]
    command.append("python")
    subprocess.run([*command, "-c", ""], env=environ, check=True)
    return shlex.join(command)


def main() -> int:
    """Make both environments and run the tests; the exit status."""
    environ = uv_environment(os.environ)
    uv = str(Path(sysconfig.get_path("scripts")) / "uv")
    install = [uv, "--quiet", "pip", "install", "--python", sys.executable]
    subprocess.run(
        [*install, "-c", "constraints.txt", "-e", ".", "-e", "plugins/vla-zenoh-franka[franky]"],
        cwd=ROOT,
        env=environ,
        check=True,
    )
    environ.setdefault(SIMULATOR, environment(uv, environ, *PACKAGES))
    if sys.argv[1:2] == ["--benchmark"]:
        for variable, packages in CONTESTANTS.items():
            environ.setdefault(variable, environment(uv, environ, *packages))
        command = [sys.executable, "-m", "benchmarks.franka", *sys.argv[2:]]
        return subprocess.run(command, cwd=ROOT, env=environ, check=False).returncode
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-m",
        "franka and not slow",
        "tests/franka",
        *sys.argv[1:],
    ]
    return subprocess.run(command, cwd=ROOT, env=environ, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
