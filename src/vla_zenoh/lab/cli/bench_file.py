"""The result file of a benchmark, and the log lines of its nodes."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vla_zenoh.cli.output import errors

if TYPE_CHECKING:
    from vla_zenoh.runtime.launch import Host

JsonFileOption = Annotated[
    Path | None, typer.Option("--json", help="Write the result to this file.")
]
LAST_LINES = 20


def write_json(json_file: Path | None, result: Any) -> None:
    """Write `result` to `json_file`, if given; creates its folder."""
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(result, indent=2) + "\n", "utf-8")


class Rows(list[dict[str, Any]]):
    """Result rows, and the log lines of the nodes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def log(self, node: str, line: str) -> None:
        """Keep a log line of a node."""
        self.lines.append(f"{node:>16} | {line}")


@contextmanager
def kept_rows(json_file: Path | None) -> Iterator[Rows]:
    """Rows that are written to `json_file` even after a failure, which shows the last log lines.

    Raises:
        typer.Exit: Ctrl-C.
    """
    from vla_zenoh.lab.episode import Interrupted

    rows = Rows()
    try:
        yield rows
    except Interrupted:
        raise typer.Exit(130) from None
    except Exception:
        errors().print("\n".join(rows.lines[-LAST_LINES:]), style="dim")
        raise
    finally:
        write_json(json_file, rows)


@contextmanager
def up_with_last_lines(host: Host, lines: Collection[str]) -> Iterator[Host]:
    """`host`, up; a failure of the block shows the last log lines.

    Args:
        host: not up yet.
        lines: log lines of its nodes, growing.
    """
    from vla_zenoh.lab.episode import Interrupted

    failed_at: list[str] = []
    try:
        with host as running:
            try:
                yield running
            except Exception:
                failed_at += lines  # before the nodes end
                raise
    except Interrupted:
        raise
    except Exception:
        last = (failed_at or [*lines])[-LAST_LINES:]
        errors().print("\n".join(last), style="dim", soft_wrap=True)
        raise
