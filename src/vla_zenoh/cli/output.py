"""Output of all commands: tables and text, errors on stderr.

Most of the text comes from elsewhere: names, states and messages of nodes, lines of a model, a
prompt. A `Screen` prints it literally, never as Rich's markup, with control characters escaped.
Colours come from `styled`. A `Screen` is made for each call, for the present terminal and streams.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from vla_zenoh.cli.plain import complain as complain
from vla_zenoh.cli.plain import fail as fail
from vla_zenoh.sanitize import printable

ENDLESS = 100_000
"""Width in characters where there is no terminal."""
LEAST_WORD, BORDER = 6, 2
"""Width of a column of wrapped words, and between columns."""
LOOK: Mapping[str, Any] = {
    "box": box.SIMPLE_HEAD,
    "padding": (0, 1, 0, 0),
    "header_style": "bold",
    "title_justify": "left",
    "caption_justify": "left",
}


class Screen(Console):
    """A Rich console for untrusted text. Takes the arguments of Rich's own.

    With NO_COLOR in the environment it has no styles at all. Without a terminal it breaks no lines.
    """

    def __init__(self, **settings: Any) -> None:
        if os.environ.get("NO_COLOR"):
            settings["color_system"] = None
        super().__init__(markup=False, emoji=False, highlight=False, **settings)
        if not self.is_terminal:
            self.width = ENDLESS

    def render_str(self, text: str, **how: Any) -> Text:
        """`text` literally, also for cells, titles and columns of tables."""
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


def console() -> Screen:
    """A console on stdout."""
    return Screen()


def errors() -> Screen:
    """A console on stderr: errors, progress, and all that is not the result."""
    return Screen(stderr=True)


def styled(text: object, style: str) -> Text:
    """Untrusted `text` in a colour."""
    return Text(printable(str(text)), style=style)


class Grid(Table):
    """A table that loses nothing.

    On a terminal it has a box. If its figures do not fit even with the other cells wrapped, or
    without a terminal, it is one line per row, in columns for grep and awk.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if console.is_terminal and self._least_width() <= options.max_width:
            yield from super().__rich_console__(console, options)
            return
        heads = [[column.header] if self.show_header else [] for column in self.columns]
        columns = [
            _aligned([*head, *column.cells], right=column.justify == "right")
            for head, column in zip(heads, self.columns, strict=True)
        ]
        rows = ["  ".join(cells).rstrip() for cells in zip(*columns, strict=True)]
        around = [[str(text)] if text else [] for text in (self.title, self.caption)]
        yield Text(printable("\n".join([*around[0], *rows, *around[1]])), overflow="fold")

    def _least_width(self) -> int:
        """Width with all words wrapped and no figure."""
        figures = [
            max(map(cell_len, _aligned([column.header, *column.cells], right=True)))
            for column in self.columns
            if column.no_wrap
        ]
        words = LEAST_WORD * (len(self.columns) - len(figures))
        return sum(figures) + words + BORDER * (len(self.columns) + 1)


def _aligned(cells: Sequence[RenderableType], *, right: bool) -> list[str]:
    """Cells as text of one line each, padded to one width."""
    texts = [cell.plain if isinstance(cell, Text) else str(cell) for cell in cells]
    lines = ["; ".join(printable(text).splitlines()) for text in texts]
    pads = [" " * (max(map(cell_len, lines)) - cell_len(line)) for line in lines]
    return [pad + line if right else line + pad for pad, line in zip(pads, lines, strict=True)]


def new_table(*columns: str, left: Collection[str] | None = None, **settings: Any) -> Grid:
    """An empty table, with settings of Rich's.

    Columns `left`, or all, hold words: aligned left, they wrap. Figures of the others do not.
    """
    table = Grid(**{**LOOK, **settings})
    for column in columns:
        words = left is None or column in left
        table.add_column(
            column, justify="left" if words else "right", overflow="fold", no_wrap=not words
        )
    return table
