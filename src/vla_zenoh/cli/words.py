"""The commands that start at once, with their options, and a parser of them without Typer.

A test compares the table with the signatures of the commands. Everything else, ``--help`` and
mistakes above all, is left to Typer.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

DEFAULT_PROFILE = "panda_sim"
PROFILE_VARIABLE = "VLA_ZENOH_PROFILE"


class Word(NamedTuple):
    """A command that starts at once; arguments that may be left out end in ``?``."""

    arguments: tuple[str, ...] = ()
    flags: Mapping[str, str] = {}
    module: str = "vla_zenoh.cli.drive"


JSON = {"--json": "as_json"}
WORDS: Mapping[str, Word] = {
    "prompt": Word(("text",), JSON),
    "activate": Word(flags={"--hold": "held", **JSON}),
    "deactivate": Word(flags=JSON),
    "use": Word(("worker",), JSON),
    "rate": Word(("rate_hz",), JSON),
    "speed": Word(("percent?",), JSON),
    "stop": Word(flags={"--all": "every", "--wait-key": "wait_key", **JSON}),
    "reset": Word(flags=JSON),
    "status": Word(flags={"--once": "once", **JSON}, module="vla_zenoh.cli.status"),
}
OPTIONS = {
    **dict.fromkeys(("--profile", "-p"), "profile"),
    **dict.fromkeys(("--connect", "-e"), "connect"),
    "--host": "host",
    "--robot": "robot",
}
"""Of every word: fields of `vla_zenoh.cli.target.RobotTarget`."""
VARIABLES = {PROFILE_VARIABLE: "profile", "VLA_ZENOH_CONNECT": "connect", "VLA_ZENOH_HOST": "host"}
REPEATABLE = frozenset({"connect"})
NUMBERS = frozenset({"rate_hz"})


def parse(words: Sequence[str]) -> tuple[str, dict[str, Any], dict[str, Any]] | None:
    """A command line as (word, its arguments, fields of its target); None: it is for Typer."""
    if not words or words[0] not in WORDS:
        return None
    word = WORDS[words[0]]
    target: dict[str, Any] = {}
    for variable, name in VARIABLES.items():
        if given := os.environ.get(variable):
            target[name] = given.split() if name in REPEATABLE else given
    found: dict[str, Any] = dict.fromkeys(word.flags.values(), False)
    positional: list[str] = []
    typed: dict[str, list[str]] = {}
    rest = iter(words[1:])
    for part in rest:
        option, equals, value = part.partition("=")
        if part in word.flags:
            found[word.flags[part]] = True
        elif option in OPTIONS and (not equals or option.startswith("--")):
            following = value if equals else next(rest, None)
            if following is None or following.startswith("-"):
                return None
            typed.setdefault(OPTIONS[option], []).append(following)
        elif part.startswith("-"):
            return None
        else:
            positional.append(part)
    needed = sum(not name.endswith("?") for name in word.arguments)
    if not needed <= len(positional) <= len(word.arguments):
        return None
    for name, value in zip(word.arguments, positional, strict=False):
        try:
            found[name.rstrip("?")] = float(value) if name in NUMBERS else value
        except ValueError:
            return None
    for name, values in typed.items():
        target[name] = values if name in REPEATABLE else values[-1]
    return words[0], found, target
