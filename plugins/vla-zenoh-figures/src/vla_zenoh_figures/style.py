"""How every figure looks: widths, font, colours, and how it is written."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec

from vla_zenoh.errors import VlaZenohError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")
COLUMN_IN, PAGE_IN = 3.4, 7.0
"""Widths of a column and of a page in two columns, inches."""
FONT_PT, LINE_PT = 8.0, 1.0
KINDS = (".pdf", ".svg", ".png")
PNG_DPI = 300
SIZES: dict[Any, Any] = {
    "font.size": FONT_PT,
    "axes.titlesize": FONT_PT,
    "axes.labelsize": FONT_PT,
    "xtick.labelsize": FONT_PT,
    "ytick.labelsize": FONT_PT,
    "legend.fontsize": FONT_PT,
    "lines.linewidth": LINE_PT,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    # Text stays text, which a journal can search and an editor can change.
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "vla-zenoh",
}


class Look(NamedTuple):
    """How one run is drawn. `dash` tells it apart on paper without colours."""

    colour: str
    dash: str | tuple[float, tuple[float, ...]]
    marker: str


LOOKS = (
    Look("#0072b2", "-", "o"),
    Look("#d55e00", (0, (4, 1.5)), "s"),
    Look("#000000", (0, (1, 1)), "^"),
    Look("#56b4e9", (0, (5, 1, 1, 1)), "D"),
    Look("#cc79a7", (0, (8, 2)), "v"),
)
"""Colours of M. Okabe and K. Ito, "Color Universal Design", 2008, of which no two look the same to
a person without red, green or blue cones."""
ASKED = "#8a8a8a"
"""Of what was commanded, beside what was measured."""


class FigureError(VlaZenohError):
    """A figure that cannot be drawn from what was given."""


class Drawn(NamedTuple):
    """A figure, and the caption with its numbers."""

    figure: Figure
    caption: str


def look(index: int, of: int) -> Look:
    """How the run with this index is drawn. Raises FigureError: more than can be told apart."""
    if of > len(LOOKS):
        raise FigureError(f"{of} runs: at most {len(LOOKS)} can be told apart in one figure")
    return LOOKS[index]


def panels(rows: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    """A figure of axes one below the other that share the horizontal one.

    Args:
        height_in: of one of them.
    """
    from matplotlib.figure import Figure

    size = (width_in, height_in * rows + 0.45)
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def styled(draw: Callable[P, Drawn]) -> Callable[P, Drawn]:
    """A drawing function whose text and lines have `SIZES`: matplotlib reads them as it draws."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Drawn:
        import matplotlib as mpl

        with mpl.rc_context(SIZES):
            return draw(*args, **kwargs)

    return drawn


def check_name(path: Path) -> None:
    """Raises FigureError: the name says no kind of file that is written."""
    if path.suffix.lower() not in KINDS:
        raise FigureError(f"--output {path}: its name must end in {', '.join(KINDS)}")


def write(drawn: Drawn, file: Path) -> None:
    """Write it, the same bytes for the same data; the caption goes into the file as well."""
    import matplotlib as mpl

    kind = file.suffix.lower()
    about = {
        ".pdf": {"Subject": drawn.caption, "CreationDate": None},
        ".svg": {"Description": drawn.caption, "Date": None},
        ".png": {"Description": drawn.caption},
    }[kind]
    with mpl.rc_context(SIZES):
        drawn.figure.savefig(file, format=kind[1:], dpi=PNG_DPI, metadata=about)
