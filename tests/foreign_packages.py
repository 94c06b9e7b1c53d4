"""Packages of a third party, as docs/how-to/plugins.md shows them, written by a test."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "plugins.md"


def files_of_the_page() -> dict[str, str]:
    """Path -> text of every file that the page shows."""
    found = re.findall(r"```\w+\n# ([\w./-]+)\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    return dict(found)


def write_page(folder: Path) -> None:
    """Write the files of the page into `folder`, and beside each package what installs it."""
    for name, text in files_of_the_page().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
        if path.name == "pyproject.toml":
            install(path)


def install(project: Path) -> None:
    """Describe a package beside its modules, so that its folder on a path is enough."""
    described = tomllib.loads(project.read_text("utf-8"))["project"]
    name, version = described["name"], described["version"]
    info = project.parent / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(exist_ok=True)
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    (info / "METADATA").write_text(metadata, "utf-8")
    entries = ""
    for group, plugins in described["entry-points"].items():
        lines = [f"{name} = {value}" for name, value in plugins.items()]
        entries += "\n".join([f"[{group}]", *lines, ""])
    (info / "entry_points.txt").write_text(entries, "utf-8")
