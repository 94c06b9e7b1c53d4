"""Tests against others' packages that put robots on Zenoh, each in an environment of its own.

    .venv/bin/python scripts/test_rivals.py [--only NAME,NAME] [PYTEST OPTIONS]
    .venv/bin/python scripts/test_rivals.py --demonstration FOLDER

uv makes the environments in ``.tools/rivals``, once. Of physicalai only what its robots' transport
imports is installed: the rest is its inference, half a gigabyte.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from collections.abc import Collection
from pathlib import Path

from bootstrap import TOOLS, uv_environment
from test_franka import PACKAGES, SIMULATOR
from test_franka import environment as simulator_environment

ROOT = Path(__file__).resolve().parent.parent
PHYSICALAI = "PHYSICALAI_PYTHON"
"""Environment variable with the Python that has physicalai."""
ALONE = ("physicalai==0.3.0",)
NEEDED = (
    "eclipse-zenoh==1.9.0",
    "iceoryx2==0.9.0",
    "jsonargparse[signatures]==4.53.0",
    "loguru==0.7.3",
    "msgpack==1.2.1",
    "numpy==2.4.6",
    "pydantic==2.14.4",
    "pyyaml==6.0.4",
)
FRANKA_NODE = "FRANKA_NODE_PYTHON"
"""Environment variable with the Python that has franka-node's client, and the loop of its arms."""
OF_FRANKA_NODE = (
    "eclipse-zenoh==1.10.2",
    "franka-node-client==0.4.0",
    "franka-rs==0.4.0",
    "numpy==2.4.6",
)
R2C = "R2C_PYTHON"
"""Environment variable with the Python that has R2C's client."""
OF_R2C = ("hw-cloudrobo-r2c[client]==0.2.1",)
TROSSEN = "TROSSEN_PYTHON"
"""Environment variable with the Python that has the simulator of a WidowX AI."""
TROSSEN_ARM = "trossen-arm==1.11.0"
"""The maker's library: beside the simulator, and for our driver."""
OF_TROSSEN = (
    "mujoco==4.0.0",
    "numpy==2.4.6",
    TROSSEN_ARM,
    "trossen-arm-sim==0.2.3",
    "websockets==17.4",
)
STRANDS = "STRANDS_PYTHON"
"""Environment variable with the Python that has strands-robots, which needs 3.12."""
OF_STRANDS = ("strands-robots[mesh]==0.5.3",)
INSPECT = "INSPECT_PYTHON"
"""Environment variable with the Python that has Inspect Robots, and us as its embodiment."""
OURS = ("vla-zenoh-policy-servers", "vla-zenoh-primitives", "vla-zenoh-inspect")
OF_INSPECT = (
    "inspect-robots==0.60.0",
    "inspect-robots-agent==0.28.0",
    *("-c", str(ROOT / "constraints.txt"), "-e", f"{ROOT}[control]"),
    *(word for name in OURS for word in ("-e", str(ROOT / "plugins" / name))),
)
RAY = "RAY_PYTHON"
"""Environment variable with the Python that has Ray Serve, and us in front of it."""
OF_RAY = (
    "ray[serve]==2.60.0",
    *("-c", str(ROOT / "constraints.txt"), "-e", f"{ROOT}"),
    *("-e", str(ROOT / "plugins" / "vla-zenoh-ray")),
)
ENVIRONMENTS: tuple[tuple[str, str, tuple[str, ...], tuple[str, ...], str], ...] = (
    (PHYSICALAI, "physicalai", ALONE, NEEDED, sys.executable),
    (FRANKA_NODE, "franka-node", (), OF_FRANKA_NODE, sys.executable),
    (R2C, "r2c", (), OF_R2C, sys.executable),
    (TROSSEN, "trossen", (), OF_TROSSEN, sys.executable),
    (STRANDS, "strands", (), OF_STRANDS, "3.12"),
    (INSPECT, "inspect", (), OF_INSPECT, sys.executable),
    (RAY, "ray", (), OF_RAY, sys.executable),
)
"""Variable, folder, packages without what they need, packages with it, Python or its version."""
NAMES = tuple(name for _, name, *_ in ENVIRONMENTS)
SHOWN = ("physicalai", "trossen")
"""What the demonstration needs."""


def environment(
    uv: str,
    environ: dict[str, str],
    name: str,
    alone: tuple[str, ...],
    needed: tuple[str, ...],
    base: str,
) -> str:
    """Make an environment unless it is there; its Python.

    Args:
        uv: its path.
        environ: what it runs in.
        name: of the folder.
        alone: packages without what they need.
        needed: packages with that.
        base: Python, or its version.
    """
    folder = TOOLS / "rivals" / name
    python, ready = folder / "bin" / "python", folder / "ready"
    told = "\n".join((*alone, *needed))
    if not ready.is_file() or ready.read_text() != told:
        install = [uv, "--quiet", "pip", "install", "--python", str(python)]
        venv = [uv, "--quiet", "venv", "--clear", "--python", base, str(folder)]
        subprocess.run(venv, env=environ, check=True)
        if alone:
            subprocess.run([*install, "--no-deps", *alone], env=environ, check=True)
        subprocess.run([*install, *needed], env=environ, check=True)
        ready.write_text(told)
    return str(python)


def library(uv: str, environ: dict[str, str], package: str) -> str:
    """Install a package alone, for our own Python, unless it is there; its folder."""
    folder = TOOLS / "rivals" / package
    if not folder.is_dir():
        install = [uv, "--quiet", "pip", "install", "--python", sys.executable, "--no-deps"]
        subprocess.run([*install, "--target", str(folder), package], env=environ, check=True)
    return str(folder)


def make(environ: dict[str, str], names: Collection[str]) -> None:
    """Make the environments of these `names`, and write into `environ` where they are.

    What `environ` names already is not made. One that cannot be had is told, and its tests are
    skipped.
    """
    uv = str(Path(sysconfig.get_path("scripts")) / "uv")
    for variable, name, alone, needed, base in ENVIRONMENTS:
        if name in names and variable not in environ:
            try:
                environ[variable] = environment(uv, environ, name, alone, needed, base)
            except subprocess.CalledProcessError:  # uv has said why
                print(f"{name}: there is no environment, its tests are skipped", file=sys.stderr)
    if TROSSEN in environ and "trossen" in names:
        paths = library(uv, environ, TROSSEN_ARM), environ.get("PYTHONPATH", "")
        environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    if "franka-node" in names and SIMULATOR not in environ:
        environ[SIMULATOR] = simulator_environment(uv, environ, *PACKAGES)


def main() -> int:
    """Make the environments and run the tests, or the demonstration; the exit status."""
    environ, given, names = uv_environment(os.environ), sys.argv[1:], NAMES
    if given[:1] == ["--only"]:
        names, given = tuple(given[1].split(",")), given[2:]
        if unknown := set(names) - set(NAMES):
            sys.exit(f"no environment {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    if given[:1] == ["--demonstration"]:
        make(environ, SHOWN)
        command = [sys.executable, "tests/rivals/demonstration", *given[1:]]
    else:
        make(environ, names)
        command = [sys.executable, "-m", "pytest", "-m", "rivals", "tests/rivals", *given]
    return subprocess.run(command, cwd=ROOT, env=environ, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
