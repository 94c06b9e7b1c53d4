"""How every command prints: tables and text for people, JSON for programs, errors on stderr.

Consoles are made at each call, so that they see the terminal, colours and streams of that moment.
"""

from __future__ import annotations

import dataclasses
import json
import math
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import typer
from pydantic import BaseModel
from rich.console import Console
from rich.text import Text

_NOT_PRINTED = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def console(least_width: int = 0) -> Console:
    """A console on stdout.

    Args:
        least_width: for a wide table, which shall rather wrap on a narrow screen than lose figures.
    """
    screen = Console(highlight=False)
    screen.width = max(screen.width, least_width)
    return screen


def errors() -> Console:
    """A console on stderr: errors, progress, and whatever is not the result."""
    return Console(stderr=True, highlight=False)


def print_json(value: Any) -> None:
    """`value` as indented JSON on stdout, without colours.

    Records, profiles, arrays, paths, sets and numpy numbers are written as what they hold; NaN and
    infinity, which JSON does not have, as null.
    """
    print(json.dumps(plain_types(value), indent=2))


def fail(message: str, code: int = 1) -> NoReturn:
    """Prints ``error: message`` on stderr and ends the command with `code`."""
    text = Text("error: ", style="bold red")
    text.append(printable(message), style="not bold default")
    errors().print(text, soft_wrap=True)
    raise typer.Exit(code)


def printable(text: str) -> str:
    """`text` from anybody, safe for a terminal: what would steer it is written as an escape."""
    return "".join(
        c
        if c in "\n\t" or unicodedata.category(c) not in _NOT_PRINTED
        else c.encode("unicode_escape", "backslashreplace").decode("ascii")
        for c in text
    )


def plain_types(value: Any) -> Any:
    """`value` made of what JSON knows, see `print_json`."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: plain_types(getattr(value, field.name)) for field in fields}
    if isinstance(value, Mapping):
        return {str(key): plain_types(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain_types(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain_types(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int, bool)):
        return value
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
