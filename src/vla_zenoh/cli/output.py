"""How every command prints: tables and text for people, JSON for programs, errors on stderr.

What is printed is mostly somebody else's: names, states and sentences of nodes, lines of a model, a
prompt. It is printed as it stands, never read as Rich's markup, and what would steer the terminal
is written as an escape. Colour is given by `styled`. Everything a person sees goes through a
`Screen`. They are made at each call, so that they see the terminal, colours and streams of then.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import typer
from pydantic import BaseModel
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from vla_zenoh.sanitize import printable


class Screen(Console):
    """A console for words of anybody, see the module. Takes what Rich's own takes."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render_str(self, text: str, **how: Any) -> Text:
        """`text` as it stands, whatever is asked for: also cells, titles and columns of tables."""
        return super().render_str(printable(text), **{**how, "markup": False, "emoji": False})

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """What Rich makes of it, where only Rich itself steers the terminal."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)


def console(least_width: int = 0) -> Screen:
    """A console on stdout.

    Args:
        least_width: for a wide table, which shall rather wrap on a narrow screen than lose figures.
    """
    screen = Screen()
    screen.width = max(screen.width, least_width)
    return screen


def errors() -> Screen:
    """A console on stderr: errors, progress, and whatever is not the result."""
    return Screen(stderr=True)


def styled(text: object, style: str) -> Text:
    """`text` of anybody in a colour."""
    return Text(printable(str(text)), style=style)


def print_json(value: Any) -> None:
    """`value` as indented JSON on stdout, without colours.

    Records, profiles, arrays, paths, sets and numpy numbers are written as what they hold; NaN and
    infinity, which JSON does not have, as null.
    """
    print(json.dumps(plain_types(value), indent=2))


def complain(message: str) -> None:
    """Prints ``error: message`` on stderr."""
    errors().print(Text.assemble(("error: ", "bold red"), printable(message)), soft_wrap=True)


def fail(message: str, code: int = 1) -> NoReturn:
    """Prints ``error: message`` on stderr and ends the command with `code`."""
    complain(message)
    raise typer.Exit(code)


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
