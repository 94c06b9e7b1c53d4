"""Sizes of an install, by what it is for: ``python scripts/install_sizes.py [WORD ...]``.

Each row is installed into an empty environment by uv, with the versions of constraints.txt, and
asked for its version; with words only the rows that have one of them. That of the demo loses its
C++ headers, as in `make demo`. A model with packages of its own adds its own environment.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bootstrap import CONSTRAINTS, DEMO, ROOT, drop_headers, uv_environment

UV = Path(sys.executable).parent / "uv"
ROWS = {
    "drive, watch, own models": ("",),
    "camera host": ("camera",),
    "model host, shipped policy": ("brick,secure",),
    "robot host": ("control,record,secure",),
    "robot host, its cameras too": ("camera,control,record,secure",),
    "robot host, ROS 2": ("record,secure", "vla-zenoh-ros2"),
    "the demo, as `make demo` has it": (DEMO,),
    "simulator and everything in the tutorial": ("all",),
    "the same with the viewer": ("all", "vla-zenoh-view"),
}
"""What it is for, its extras, and packages of ``plugins/``."""
LARGEST = 3


def size_mb(folder: Path) -> float:
    """Size of a folder, every file once."""
    sizes = {(s.st_dev, s.st_ino): s.st_size for p in folder.rglob("*") if (s := p.lstat())}
    return sum(sizes.values()) / 1e6


def measure(extras: str, packages: Sequence[str], folder: Path) -> tuple[float, str]:
    """Installs, and returns its size in MB and its largest packages."""
    core = f"{ROOT}[{extras}]" if extras else str(ROOT)
    wanted = [core, *(ROOT / "plugins" / package for package in packages)]
    environ = uv_environment(os.environ)
    python = folder / "bin" / "python"
    for command in (
        [UV, "--quiet", "venv", "--python", sys.executable, folder],
        [UV, "--quiet", "pip", "install", "--python", python, "-c", CONSTRAINTS, *wanted],
        [folder / "bin" / "vla-zenoh", "--version"],
    ):
        subprocess.run(
            [str(word) for word in command], check=True, env=environ, stdout=subprocess.DEVNULL
        )
    if extras == DEMO:
        drop_headers(folder)
    packages = next((folder / "lib").glob("python*")) / "site-packages"
    sizes = sorted(((size_mb(p), p.name) for p in packages.iterdir() if p.is_dir()), reverse=True)
    largest = ", ".join(f"{name} {size:.0f}" for size, name in sizes[:LARGEST])
    return size_mb(folder), largest


def main() -> None:
    """Prints the table."""
    print("| for | extras | MB | largest |\n|---|---|---|---|")
    words = sys.argv[1:] or [""]
    for purpose, (extras, *packages) in ROWS.items():
        if not any(word in purpose for word in words):
            continue
        with tempfile.TemporaryDirectory(prefix="vla-zenoh-size-") as name:
            size, largest = measure(extras, packages, Path(name) / "venv")
        label = ", ".join(f"`{each}`" for each in (extras, *packages) if each) or "none"
        print(f"| {purpose} | {label} | {size:.0f} | {largest} |", flush=True)


if __name__ == "__main__":
    main()
