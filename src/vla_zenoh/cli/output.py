"""Output of all commands: tables and text, JSON, errors on stderr.

Most of the text comes from elsewhere: names, states and messages of nodes, lines of a model, a
prompt. A `Screen` prints it as it is, never as Rich's markup, with control characters escaped.
Colours come from `styled`. A `Screen` is made for each call, for the terminal and streams of then.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from vla_zenoh.cli.plain import complain as complain
from vla_zenoh.cli.plain import fail as fail
from vla_zenoh.sanitize import printable


class Screen(Console):
    """A Rich console for untrusted text. Takes the arguments of Rich's own."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render_str(self, text: str, **how: Any) -> Text:
        """`text` as it is, also for cells, titles and columns of tables."""
        return super().render_str(printable(text), **{**how, "markup": False, "emoji": False})

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Segments of Rich, with control characters only from Rich itself."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(printable(segment.text), segment.style)


def console(least_width: int = 0) -> Screen:
    """A console on stdout.

    Args:
        least_width: of a wide table, which on a narrow screen wraps rather than lose figures.
    """
    screen = Screen()
    screen.width = max(screen.width, least_width)
    return screen


def errors() -> Screen:
    """A console on stderr: errors, progress, and all that is not the result."""
    return Screen(stderr=True)


def styled(text: object, style: str) -> Text:
    """Untrusted `text` in a colour."""
    return Text(printable(str(text)), style=style)


def new_table(
    *columns: str, title: str | None = None, left: Collection[str] | None = None
) -> Table:
    """An empty table.

    Args:
        columns: their names.
        title: of the table.
        left: columns that are aligned left, the others right; None: all left, in which long text
            wraps.
    """
    table = Table(header_style="bold", title=title, title_justify="left")
    for column in columns:
        aligned = "left" if left is None or column in left else "right"
        table.add_column(column, justify=aligned, overflow="fold" if left is None else "ellipsis")
    return table


def progress_bars(width: int, screen: Screen | None = None, *, counted: bool = True) -> Progress:
    """Progress bars on stderr.

    Args:
        width: of the descriptions, in characters.
        screen: another console.
        counted: show how many of how many are done.
    """
    return Progress(
        TextColumn(f"{{task.description:<{width}}}", markup=False),
        BarColumn(),
        *([MofNCompleteColumn()] if counted else []),
        TimeElapsedColumn(),
        console=screen or errors(),
    )


def print_json(value: Any) -> None:
    """Print `value` as indented JSON on stdout, without colours; see `plain_types`."""
    print(json.dumps(plain_types(value), indent=2))


def plain_types(value: Any) -> Any:
    """`value` in types of JSON.

    Records, profiles, arrays, paths, sets and numpy numbers become what they hold; NaN and infinity
    become null.
    """
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
