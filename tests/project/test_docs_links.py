"""What the documentation names is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("models/*/*.md")])
LINK = re.compile(r"\]\(([^)\s#]+)(#[\w-]+)?\)")
FILE = re.compile(r"`((?:[\w-]+/)+[\w.-]+\.(?:py|yaml|md|c))`")
BARE = re.compile(r"`(\w+\.py)`")
ABOUT_OUR_FILES = (ROOT / "CONTRIBUTING.md", ROOT / "docs" / "design.md")
BASES = (ROOT, ROOT / "src" / "vla_zenoh")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file(page: Path) -> None:
    links = [found[1] for found in LINK.finditer(page.read_text("utf-8"))]
    local = [link for link in links if not re.match(r"\w+:", link)]
    assert [link for link in local if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_that_is_named_exists(page: Path) -> None:
    named = {found[1] for found in FILE.finditer(page.read_text("utf-8"))}
    missing = {name for name in named if not any((base / name).exists() for base in BASES)}
    assert {name for name in missing if not name.startswith(("runs/", "reference/"))} == set()


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    given = {found for each in headings for found in re.findall(r"{(#[\w-]+)}", each)}
    plain = [re.sub(r"[^\w\s-]", "", each).strip().lower() for each in headings]
    return given | {"#" + re.sub(r"\s+", "-", each) for each in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_heading(page: Path) -> None:
    text = page.read_text("utf-8")
    for file, anchor in re.findall(r"\]\(([\w./-]*\.md)?(#[\w-]+)\)", text):
        assert anchor in anchors(page.parent / file if file else page), (file, anchor)


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
