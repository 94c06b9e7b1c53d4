"""What a lab network's faults do to an arm in motion, as a table.

    make bench-faults ARGS="--only cut-5 -o faults.json"

Needs root. Hosts are network namespaces with mutual TLS and access control; every row is one motion
of the simulated arm, measured from what its simulator logged. Rewrites the table of
docs/explanation/reliability.md; with --only, those rows.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

# Run as a program, and not by pytest, which knows where the rest of the tests' own code is.
ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "reliability"), str(ROOT / "tests")]

from netns import table
from netns.faults import catalogue
from netns.lab import why_not
from netns.rows import Fault, Row
from netns.stage import stage
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

DOCUMENT = ROOT / "docs" / "explanation" / "reliability.md"
MAX_FAULTS_A_LAB = 12
"""Then the lab is built anew: a row shall not suffer from those before it."""


def rows(faults: list[Fault], screen: Console) -> Iterator[Row]:
    """Suffer them all, with a bar for people."""
    with Progress(
        TextColumn("{task.description:<36}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=screen,
    ) as bars:
        bar = bars.add_task("", total=len(faults))
        for layout, group in groupby(faults, lambda fault: fault.layout):
            of_layout = list(group)
            for at in range(0, len(of_layout), MAX_FAULTS_A_LAB):
                bars.update(bar, description=f"starting the hosts of {layout!r}")
                with stage(layout) as built:
                    for fault in of_layout[at : at + MAX_FAULTS_A_LAB]:
                        bars.update(bar, description=fault.name)
                        row = built.suffer(fault)
                        bars.advance(bar)
                        bars.console.print(table.line(row), markup=False, soft_wrap=True)
                        yield row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="write all figures to this file")
    parser.add_argument("--only", action="append", help="this fault; may be given more than once")
    parser.add_argument("--no-table", action="store_true", help="do not rewrite the table in docs/")
    given = parser.parse_args()
    screen = Console(stderr=True)
    every = list(catalogue())
    names = [fault.name for fault in every]
    unknown = sorted(set(given.only or ()) - set(names))
    if unknown:
        screen.print(f"no such fault: {', '.join(unknown)}; there are: {', '.join(names)}")
        return 2
    if why := why_not():
        screen.print(f"skipped: {why}")
        return 0
    chosen = [fault for fault in every if not given.only or fault.name in given.only]
    for fault in chosen:
        if fault.needs:
            screen.print(f"skipped: {fault.name}: {fault.needs}")
    chosen = [fault for fault in chosen if not fault.needs]
    done: list[Row] = []
    try:
        for row in rows(chosen, screen):
            done.append(row)
    finally:
        if given.output is not None:
            given.output.write_text(json.dumps([row.to_dict() for row in done], indent=2) + "\n")
        if not given.no_table:
            table.write(DOCUMENT, done, names)
    wrong = [f"{row.name}: {fault}" for row in done for fault in row.wrong]
    screen.print("\n".join(wrong) or f"{len(done)} faults, no promise broken", markup=False)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
