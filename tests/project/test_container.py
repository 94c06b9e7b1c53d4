"""The container file names what there is."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONTAINERFILE = (ROOT / "examples" / "container" / "Containerfile").read_text("utf-8")
PAGE = (ROOT / "docs" / "how-to" / "service.md").read_text("utf-8")


def test_every_extra_of_the_container_file_and_its_page_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    sets = re.findall(r"EXTRAS=([a-z0-9,]+)", CONTAINERFILE + PAGE)
    sets += re.findall(r"\.whl\)\[([a-z0-9,]+)\]", PAGE)
    assert len(sets) >= 5
    assert {name for one in sets for name in one.split(",")} <= set(
        project["optional-dependencies"]
    )


def test_the_page_builds_with_the_options_of_the_container_file() -> None:
    builds = re.findall(r"docker build (.*) \S+\n", CONTAINERFILE)
    assert len(builds) == 2
    for options in builds:
        assert f"docker build {options} context" in PAGE


def test_the_container_installs_without_an_index() -> None:
    installs = [line for line in CONTAINERFILE.splitlines() if "pip install" in line]
    assert installs
    assert all("--no-index" in line for line in installs)
