"""Output of the commands that drive: one line each, without Rich, which takes 100 ms to load.

Or one JSON object for all lines of a command, with ``--json``::

    {"ok": true, "messages": ["..."], "warnings": [], "errors": [], "reasons": []}
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn, TextIO

from vla_zenoh.errors import VlaZenohError
from vla_zenoh.sanitize import printable

BOLD_RED, YELLOW = "1;31", "33"
REASON = "\n  - "
"""In front of each reason of an error that has several."""
_answers: list[dict[str, list[str]]] = []


@contextmanager
def json_answer() -> Iterator[None]:
    """Print what the block says as one JSON object on stdout; exit with 1 after our own errors."""
    answer: dict[str, list[str]] = {"messages": [], "warnings": [], "errors": [], "reasons": []}
    _answers.append(answer)
    ok = False
    try:
        yield
        ok = True
    except VlaZenohError as error:
        first, *reasons = str(error).split(REASON)
        answer["errors"].append(first)
        answer["reasons"] += reasons
        raise SystemExit(1) from error
    finally:
        _answers.remove(answer)
        print(json.dumps({"ok": ok, **answer}), flush=True)


def _kept(what: str, text: str) -> bool:
    for answer in _answers[-1:]:
        answer[what].append(text)
    return bool(_answers)


def say(text: str) -> None:
    """Print untrusted text as one paragraph on stdout."""
    if not _kept("messages", text):
        print(printable(text), flush=True)


def say_marked(word: str, colour: str, rest: str) -> None:
    """Print a line whose first word is coloured on a terminal."""
    if not _kept("messages", f"{word}{rest}"):
        print(f"{_coloured(word, colour, sys.stdout)}{printable(rest)}", flush=True)


def warn(text: str) -> None:
    """Print untrusted text in yellow on stderr."""
    if not _kept("warnings", text):
        print(_coloured(text, YELLOW, sys.stderr), file=sys.stderr, flush=True)


def complain(message: str) -> None:
    """Print ``error: message`` on stderr."""
    if _kept("errors", message):
        return
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
