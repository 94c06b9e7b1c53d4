"""A user's options of a model: options are text (``--set name=value``), weights are in a folder."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh.errors import SpecError, WorkerError

SECRET = "api_"
"""Prefix of the names of options that must not be shown (`api_key`)."""


def shown(options: Mapping[str, str]) -> dict[str, str]:
    """Options as they may be written into a result, without the secret ones."""
    return {k: "(secret)" if k.startswith(SECRET) else value for k, value in options.items()}


def one_of(name: str, value: str, allowed: Sequence[str]) -> str:
    """The option's value.

    Raises:
        SpecError: it is not allowed; lists what is.
    """
    if value not in allowed:
        raise SpecError(f"{name} is {value!r}, allowed: {', '.join(allowed)} (--set {name}=...)")
    return value


def yes_no(name: str, value: str) -> bool:
    """The option as a truth value.

    Raises:
        SpecError: it is neither yes nor no.
    """
    return one_of(name, value, ("yes", "no")) == "yes"


def number(name: str, text: str, *, least: float = 0.0) -> float:
    """The option's number, `least` or more.

    Raises:
        SpecError: it is none, not finite, or smaller.
    """
    try:
        value = float(text)
    except ValueError as error:
        raise SpecError(f"{name} is {text!r}, wanted a number") from error
    if not math.isfinite(value) or value < least:
        bound = "a finite number" if least == -math.inf else f"a finite number from {least:g} up"
        raise SpecError(f"{name} is {text!r}, wanted {bound}")
    return value


def whole_number(name: str, text: str, *, least: int = 0) -> int:
    """An option that is a whole number.

    Raises:
        SpecError: it is none, or smaller.
    """
    value = number(name, text, least=least)
    if value != int(value):
        raise SpecError(f"{name} is {text!r}, wanted a whole number")
    return int(value)


def checkpoint_folder(text: str) -> Path:
    """The option `checkpoint`.

    Raises:
        WorkerError: it is empty, or no folder.
    """
    if not text:
        raise WorkerError("it needs weights: --set checkpoint=DIRECTORY")
    folder = Path(text).expanduser()
    refuse_dead_link(folder)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "not there"
        raise WorkerError(
            f"checkpoint {text!r} is {what}, wanted a folder: looked at {folder.absolute()}. "
            "./PATH in a profile's options starts at the profile, with --set at this folder"
        )
    return folder


def refuse_dead_link(path: Path) -> None:
    """Raise a `WorkerError` if `path`, or a folder that it is in, is a link that leads nowhere."""
    for each in (path, *path.parents):
        if each.is_symlink() and not each.exists():
            raise WorkerError(
                f"{each} is a link to {each.readlink()}, which is not there: a copy of a training "
                "needs what its links lead to; give the folder itself"
            )


def read_json(file: Path) -> dict[str, Any]:
    """Content of a JSON file that is an object.

    Raises:
        WorkerError: it cannot be read or is something else.
    """
    try:
        content = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise WorkerError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise WorkerError(f"{file}: wanted a JSON object")
    return content
