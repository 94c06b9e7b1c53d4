"""Output of the lab's commands beside `cli.output`: JSON, progress."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.status import Status

from vla_zenoh.cli.output import errors, styled


def progress_bars(width: int, *, counted: bool = True) -> Progress:
    """Progress bars on stderr.

    Args:
        width: of the descriptions, in characters.
        counted: show how many of how many are done.
    """
    return Progress(
        TextColumn(f"{{task.description:<{width}}}", markup=False),
        BarColumn(),
        *([MofNCompleteColumn()] if counted else []),
        TimeElapsedColumn(),
        console=errors(),
    )


def progress(doing: str) -> Status:
    """A line with a spinner on stderr, for what takes longer than a moment; not in a pipe."""
    return errors().status(styled(doing, ""))


def print_json(value: Any) -> None:
    """Print `value` as indented JSON on stdout, without colours; see `plain_types`."""
    print(json.dumps(plain_types(value), indent=2))


def plain_types(value: Any) -> Any:
    """`value` in types of JSON: records, profiles and arrays as their content, NaN as null."""
    return to_jsonable_python(value, inf_nan_mode="null", bytes_mode="hex", fallback=_plain)


def _plain(value: Any) -> Any:
    """What Pydantic does not know."""
    if isinstance(value, Mapping):
        return {str(key): item for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")
