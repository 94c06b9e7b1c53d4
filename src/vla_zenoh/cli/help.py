"""Help and completion of the commands; the examples are in ``examples.txt``."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from importlib.resources import files
from textwrap import indent
from typing import Any

from vla_zenoh.cli.completion import add_completion

PROGRAM = "vla-zenoh"
MAX_SHORT = 200
VERBATIM = "\b\n"
"""Keeps the lines of a paragraph as they are."""


def examples() -> Iterator[tuple[list[str], str]]:
    """Words and text of every example; the text begins with its comment, if it has one."""
    comment = ""
    text = files("vla_zenoh.cli").joinpath("examples.txt").read_text("utf-8")
    for line in text.splitlines():
        if line.startswith("#"):
            comment = f"{line}\n"
        elif line:
            yield shlex.split(line, comments=True), comment + line
            comment = ""


def add_help(command: Any, path: Sequence[str]) -> None:
    """Let a command, and all below it, complete its words and show its examples."""
    command.short_help = command.get_short_help_str(MAX_SHORT)  # Typer would cut it off
    if hasattr(command, "commands"):
        for name, found in command.commands.items():
            add_help(found, (*path, name))
        return
    for parameter in command.params:
        add_completion(parameter, " ".join(path))
    wanted = [PROGRAM, *path]
    found = [text for words, text in examples() if words[: len(wanted)] == wanted]
    if found:
        command.epilog = VERBATIM + "Examples:\n" + indent("\n".join(found), "  ")
