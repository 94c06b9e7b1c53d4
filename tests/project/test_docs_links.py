"""What the documentation names is there."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("*.md", "docs/**/*.md", "models/*/*.md")
PAGES = {page: page.read_text("utf-8") for folder in FOLDERS for page in ROOT.glob(folder)}
LINK = re.compile(r"\]\(([^)\s#]+)(#[\w-]+)?\)")
FILE = re.compile(r"`((?:[\w-]+/)+[\w.-]+\.(?:py|yaml|md|c))`")
BARE = re.compile(r"`(\w+\.py)`")
ABOUT_OUR_FILES = (ROOT / "CONTRIBUTING.md", ROOT / "docs" / "design.md")
BASES = (ROOT, ROOT / "src" / "vla_zenoh")


def test_every_link_leads_to_a_file() -> None:
    links = [(page, found[1]) for page, text in PAGES.items() for found in LINK.finditer(text)]
    local = [(page, link) for page, link in links if not re.match(r"\w+:", link)]
    assert [(page, link) for page, link in local if not (page.parent / link).exists()] == []


def test_every_file_that_is_named_exists() -> None:
    named = [(page, found[1]) for page, text in PAGES.items() for found in FILE.finditer(text)]
    missing = [each for each in named if not any((base / each[1]).exists() for base in BASES)]
    assert [each for each in missing if not each[1].startswith(("runs/", "reference/"))] == []


@cache
def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    given = {found for each in headings for found in re.findall(r"{(#[\w-]+)}", each)}
    plain = [re.sub(r"[^\w\s-]", "", each).strip().lower() for each in headings]
    return given | {"#" + re.sub(r"\s+", "-", each) for each in plain}


def test_every_link_leads_to_a_heading() -> None:
    for page, text in PAGES.items():
        for file, anchor in re.findall(r"\]\(([\w./-]*\.md)?(#[\w-]+)\)", text):
            assert anchor in anchors(page.parent / file if file else page), (page, file, anchor)


@pytest.mark.parametrize("page", ABOUT_OUR_FILES, ids=lambda page: page.stem)
def test_every_file_that_is_named_without_its_folder_exists(page: Path) -> None:
    names = {
        file.name
        for folder in ("src", "models", "plugins", "tests")
        for file in (ROOT / folder).rglob("*.py")
    }
    assert {found[1] for found in BARE.finditer(page.read_text("utf-8"))} <= names


def test_the_readme_fits_on_a_few_screens() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 120
