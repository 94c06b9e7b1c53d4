"""What installs from wheels, by host role: ``python scripts/wheel_table.py [WORD ...]``.

The index is asked by uv for each processor and version of Python, and nothing is installed. A
package without a wheel there is named, and left out of the next try. With words only the roles that
have one of them.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

from bootstrap import ROOT, uv_environment

UV = Path(sys.executable).parent / "uv"
ROLES: dict[str, tuple[str, ...]] = {
    "operator, own models": (),
    "camera host": ("camera",),
    "model host, shipped policy": ("brick", "secure"),
    "robot host": ("control", "record", "secure"),
    "simulator, the demo": ("brick", "sim"),
    "robot host, Franka": ("control", "record", "secure", "franka:franky"),
    "robot host, UR": ("control", "record", "secure", "ur:rtde"),
}
"""Extras of the package, and PLUGIN:EXTRA of ``plugins/``."""
PROCESSORS = {"x86-64": "x86_64-manylinux_2_28", "aarch64": "aarch64-manylinux_2_28"}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
LACKING = re.compile(r"Wheels are (?:required|available) for `([^`]+)`")
MOST_LACKING = 10


def requirements(extras: Sequence[str]) -> list[str]:
    """What pip would be told to install: of the package, and of plug-ins beside it."""
    wanted = [_of(ROOT, extra) for extra in ("", *(each for each in extras if ":" not in each))]
    for plugin, _, extra in (each.partition(":") for each in extras if ":" in each):
        wanted.append(_of(ROOT / "plugins" / f"vla-zenoh-{plugin}", extra))
    return sorted({each for some in wanted for each in some if not each.startswith("vla-zenoh")})


def _of(folder: Path, extra: str) -> list[str]:
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    found = project["optional-dependencies"][extra] if extra else project["dependencies"]
    # An extra may name others of its own package.
    own = re.compile(rf"{project['name']}\[(.+)\]")
    names = [match[1].split(",") for each in found if (match := own.fullmatch(each))]
    return [*found, *(each for some in names for name in some for each in _of(folder, name))]


def lacking(wanted: Sequence[str], platform: str, python: str) -> list[str]:
    """Packages without a wheel, among the requirements and what they require."""
    command = [UV, "pip", "compile", "--quiet", "--python-platform", platform, "--python-version"]
    command += [python, "--only-binary", ":all:", "--no-header", "--no-annotate"]
    missing: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        given, left_out = Path(name) / "requirements.in", Path(name) / "overrides.txt"
        given.write_text("\n".join(wanted))
        while len(missing) < MOST_LACKING:
            left_out.write_text("".join(f"{each}; sys_platform == 'none'\n" for each in missing))
            words = [str(word) for word in (*command, "--override", left_out, given)]
            environ = uv_environment(os.environ)
            done = subprocess.run(words, capture_output=True, text=True, check=False, env=environ)
            if done.returncode == 0:
                return missing
            found = LACKING.search(done.stderr)
            if found is None or found[1] in missing:
                sys.exit(f"uv failed for another reason than a missing wheel:\n{done.stderr}")
            missing.append(found[1])
    return missing


def main() -> None:
    """Prints the table."""
    print("| host | processor |", " | ".join(PYTHONS), "|")
    print("|---" * (2 + len(PYTHONS)) + "|")
    words = sys.argv[1:] or [""]
    for role, extras in ROLES.items():
        if not any(word in role for word in words):
            continue
        wanted = requirements(extras)
        for processor, platform in PROCESSORS.items():
            cells = [", ".join(lacking(wanted, platform, python)) for python in PYTHONS]
            shown = " | ".join(f"no {cell}" if cell else "wheels" for cell in cells)
            print(f"| {role} | {processor} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
