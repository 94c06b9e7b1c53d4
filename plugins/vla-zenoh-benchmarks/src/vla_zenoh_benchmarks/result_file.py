"""Where the result of a benchmark goes: tables, or JSON in a file."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import RenderableType

from vla_zenoh.cli.options import JsonOption
from vla_zenoh.cli.output import console, errors
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_file
from vla_zenoh.lab.cli.running_nodes import LAST_LINES


@dataclass(frozen=True)
class ResultOptions:
    """Options for where the result of a benchmark goes."""

    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File for the result, as JSON.")
    ] = None
    force: ForceOption = False
    as_json: JsonOption = False

    def open(self) -> AbstractContextManager[Path | None]:
        """The file to write, if one is wanted; see `output_file`."""
        return if_wanted(output_file, self.output, force=self.force)

    def show(self, result: Any, *tables: RenderableType) -> None:
        """Print `result` as JSON if that is wanted, else `tables`."""
        if self.as_json:
            print_json(result)
            return
        for table in tables:
            console().print(table)


def write_json(file: Path | None, result: Any) -> None:
    """Write `result` to `file`, if there is one."""
    if file is not None:
        file.write_text(json.dumps(result, indent=2) + "\n", "utf-8")


def rate_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Successes, episodes, rate and its interval at 95 %, for a table."""
    low, high = row["wilson_95"]
    rate = f"{row['success_rate']:.1%}" if row["episodes"] else ""
    return str(row["successes"]), str(row["episodes"]), rate, f"{low:.1%}..{high:.1%}"


def counts(of: Mapping[str, int]) -> str:
    """Counts as text: ``dropped 3, fell 1``."""
    return ", ".join(f"{name} {count}" for name, count in of.items())


class Rows(list[dict[str, Any]]):
    """Result rows, and the log lines of the nodes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def log(self, node: str, line: str) -> None:
        """Keep a log line of a node."""
        self.lines.append(f"{node:>16} | {line}")


@contextmanager
def kept_rows(
    options: ResultOptions, tables: Callable[[Rows], Iterable[RenderableType]]
) -> Iterator[Rows]:
    """Rows that are written and shown, those before a failure or Ctrl-C, too.

    A failure shows the last log lines as well.

    Args:
        tables: of the rows, for a person.

    Raises:
        typer.Exit: Ctrl-C.
    """
    from vla_zenoh.lab.episode import Interrupted

    rows = Rows()
    with options.open() as file:
        try:
            yield rows
        except Interrupted:
            raise typer.Exit(130) from None
        except Exception:  # whatever it is, it goes on after the log lines
            errors().print("\n".join(rows.lines[-LAST_LINES:]), style="dim")
            raise
        finally:
            if rows:
                write_json(file, rows)
                options.show(rows, *tables(rows))
