"""Rows of faults as a table in a Markdown file, where rows that were not run again stay."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from netns.rows import Row

BEGIN, END = "<!-- faults: made by make bench-faults -->", "<!-- faults end -->"
HEAD = (
    "| fault | what the arm did | stood after, way | braked within (allowed) "
    "| peak acceleration, jerk | moved again after | records lost | refused |",
    "|---|---|---|---|---|---|---|---|",
)
SHOWN = 3
"""Keys and reasons in a cell; the others are summed up."""


def line(row: Row) -> str:
    """A row of the table."""
    cells = (
        f"`{row.name}` {row.about}",
        row.did + "".join(f"; **{fault}**" for fault in row.wrong),
        _stood(row),
        _braked(row),
        f"{row.acceleration:.2f}, {row.jerk:.2f}",
        _recovered(row),
        _counts(row.lost),
        _counts(row.refused),
    )
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def _stood(row: Row) -> str:
    if row.stood_s is None:
        return "-"
    return f"{row.stood_s:.2f} s, {row.way_mm or 0.0:.0f} mm"


def _braked(row: Row) -> str:
    if row.braked_s is None or row.braked_bound_s is None:
        return "-"
    return f"{row.braked_s:.2f} s ({row.braked_bound_s:.2f})"


def _recovered(row: Row) -> str:
    if row.off_mm is not None:
        return f"goal to {row.off_mm:.2f} mm"
    if row.recovered_s is None:
        return "-"
    how = ", activated" if row.activated else ""
    return f"{row.recovered_s:.2f} s{how}"


def _counts(counts: Mapping[str, int]) -> str:
    most = sorted(counts.items(), key=lambda pair: -pair[1])
    shown = [f"{name} {count}" for name, count in most[:SHOWN]]
    rest = sum(count for _, count in most[SHOWN:])
    return ", ".join([*shown, *([f"others {rest}"] if rest else [])]) or "0"


def write(path: Path, rows: Iterable[Row], order: Sequence[str]) -> None:
    """Put `rows` into the table of a file, in this order of names.

    Raises:
        ValueError: the file has no place for it.
    """
    text = path.read_text("utf-8")
    before, begin, rest = text.partition(BEGIN)
    old, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{path} has no {BEGIN} and {END}")
    lines = {found[1]: found[0] for found in re.finditer(r"^\| `([^`]+)` .*$", old, re.M)}
    lines |= {row.name: line(row) for row in rows}
    body = [*HEAD, *(lines[name] for name in order if name in lines)]
    path.write_text("\n".join([f"{before}{BEGIN}", *body, f"{END}{after}"]), "utf-8")
