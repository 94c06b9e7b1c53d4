"""Output of the commands that drive: one line each, without Rich, which takes 100 ms to load."""

from __future__ import annotations

import os
import sys
from typing import NoReturn, TextIO

from vla_zenoh.sanitize import printable

BOLD_RED, YELLOW = "1;31", "33"


def say(text: str) -> None:
    """Print untrusted text as one paragraph on stdout."""
    print(printable(text), flush=True)


def say_marked(word: str, colour: str, rest: str) -> None:
    """Print a line whose first word is coloured on a terminal."""
    print(f"{_coloured(word, colour, sys.stdout)}{printable(rest)}", flush=True)


def warn(text: str) -> None:
    """Print untrusted text in yellow on stderr."""
    print(_coloured(text, YELLOW, sys.stderr), file=sys.stderr, flush=True)


def complain(message: str) -> None:
    """Print ``error: message`` on stderr."""
    marked = _coloured("error: ", BOLD_RED, sys.stderr)
    print(f"{marked}{printable(message)}", file=sys.stderr, flush=True)


def fail(message: str, code: int = 1) -> NoReturn:
    """Print ``error: message`` on stderr and exit with `code`."""
    complain(message)
    raise SystemExit(code)


def _coloured(text: str, colour: str, stream: TextIO) -> str:
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    if plain or not stream.isatty():
        return printable(text)
    return f"\x1b[{colour}m{printable(text)}\x1b[0m"
