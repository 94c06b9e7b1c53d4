"""The file a benchmark writes; of one that takes long it is kept, however that ends."""

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
    """Write `result` where a file was asked for; its folder is made."""
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(result, indent=2) + "\n", "utf-8")


class Rows(list[dict[str, Any]]):
    """One row of figures each, and what the nodes wrote meanwhile."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def log(self, node: str, line: str) -> None:
        """Keep a line of a node."""
        self.lines.append(f"{node:>16} | {line}")


@contextmanager
def kept_rows(json_file: Path | None) -> Iterator[Rows]:
    """Rows that are written to `json_file` at the end; the last lines are shown where it fails.

    Raises:
        typer.Exit: somebody ended it.
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
    """`host`, up; where what is done with it fails, the last of `lines` is shown.

    Args:
        host: not up yet.
        lines: what its nodes write, growing.
    """
    from vla_zenoh.lab.episode import Interrupted

    failed_at: list[str] = []
    try:
        with host as running:
            try:
                yield running
            except Exception:
                failed_at += lines  # before the nodes take their leave
                raise
    except Interrupted:
        raise
    except Exception:
        last = (failed_at or [*lines])[-LAST_LINES:]
        errors().print("\n".join(last), style="dim", soft_wrap=True)
        raise
