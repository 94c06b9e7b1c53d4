"""The commands of the pages exist, with their options, and lack none that is required."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from vla_zenoh.program.main import app

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FEWEST = 150
"""The pages have more commands than this: with fewer, the search misses them."""
SEPARATORS = {";", "&&", "|", ">"}
PLACEHOLDER = re.compile(r"\.\.\.|[a-z]\|[a-z]|\b[A-Z]+\|[A-Z]+\b|\[-")
"""In a line that lists what may be given: its values are no values."""


def command_lines(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Indented lines, and the words after ``vla-zenoh`` of each command in them."""
    text = re.sub(r" *\\?\n {8,}", " ", page.read_text("utf-8"))
    for line in re.findall(r"^ {4}(?! )(.*\bvla-zenoh .*)$", text, re.MULTILINE):
        words = shlex.shlex(re.sub(r"[\[\]]", "", line), posix=True, punctuation_chars=True)
        words.whitespace_split = True
        for is_separator, part in groupby(words, SEPARATORS.__contains__):
            found = [] if is_separator else list(part)
            names = [at for at, word in enumerate(found) if word.rpartition("/")[2] == "vla-zenoh"]
            if names:
                yield line, found[names[0] + 1 :]


def commands_in_sentences(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Those in backticks, which need not be whole."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    for line in re.findall(r"`(vla-zenoh [a-z][^`]*)`", text):
        yield line, re.sub(r"[\[\]]", "", line).split("&&")[0].split()[1:]


def test_the_commands_are_found() -> None:
    assert sum(1 for page in PAGES for _ in command_lines(page)) > FEWEST


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_commands_of_a_page_can_be_typed(page: Path) -> None:
    """Parsed as the command line does, up to where the command would run."""
    whole = [(True, *each) for each in command_lines(page)]
    parts = [(False, *each) for each in commands_in_sentences(page)]
    for is_whole, line, words in whole + parts:
        command: Any = get_command(app)
        context = command.make_context("vla-zenoh", [], resilient_parsing=True)
        rest = words
        while hasattr(command, "get_command") and rest:
            found = command.get_command(context, rest[0])
            assert found is not None, line
            command, rest = found, rest[1:]
        if not is_whole or PLACEHOLDER.search(line):
            known = {name for parameter in command.params for name in parameter.opts}
            given = {word.partition("=")[0] for word in rest if re.match(r"--?[a-z]", word)}
            assert given <= known, (line, given - known)
        else:
            command.make_context(words[0], list(rest))
