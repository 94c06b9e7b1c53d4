"""Files that survive a power cut, a lock of a folder, and the templates of pages."""

from __future__ import annotations

import fcntl
import os
from importlib.resources import files
from pathlib import Path
from typing import Any

from vla_zenoh.errors import MissingExtraError


def write_whole(path: Path, text: str) -> None:
    """Write a file; a reader sees the old one or the new one, never half of one."""
    part = path.with_name(f"{path.name}.part")
    with part.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def lock_folder(folder: Path) -> int:
    """A file descriptor that keeps other processes from locking a folder until it is closed.

    Raises:
        BlockingIOError: another process has it.
    """
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    return lock


def page_language() -> Any:
    """The environment of HTML templates. Raises MissingExtraError: jinja2 is not installed."""
    try:
        from jinja2 import Environment
    except ImportError as error:
        raise MissingExtraError("jinja2", "record") from error
    return Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)


def page_template(package: str, name: str) -> Any:
    """A template that lies in a package."""
    return page_language().from_string(files(package).joinpath(name).read_text("utf-8"))
