"""Files that survive a power cut, a lock of a folder, and the templates of pages.

A line that a power cut left incomplete is none: it is not read, and the next one takes its place.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import IO, Any

from vla_zenoh.errors import MissingExtraError, VlaZenohError


@contextmanager
def writing(path: Path, kind: type[VlaZenohError]) -> Iterator[None]:
    """Turn an `OSError` into an error of this kind, which says that the file cannot be written."""
    try:
        yield
    except OSError as error:
        raise kind(f"{path} cannot be written: {error.strerror}") from error


def write_whole(path: Path, content: str | bytes, mode: int = 0o666) -> None:
    """Write a file; a reader sees the old one or the new one, never half of one.

    Args:
        mode: that it has from the start, less what the umask forbids.
    """
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    _sync_folder(path.parent)


def append_lines(path: Path, lines: Iterable[str]) -> None:
    """Append lines to a file; all are on the disk when this returns, none after an error."""
    data = "".join(f"{line}\n" for line in lines).encode()
    with path.open("ab+", buffering=0) as file:
        end = _end_of_lines(file)
        file.truncate(end)
        try:
            while data:
                data = data[file.write(data) :]
        except OSError:
            file.truncate(end)
            raise
        os.fsync(file.fileno())
    _sync_folder(path.parent)


def _end_of_lines(file: IO[bytes]) -> int:
    """Where the last complete line of a file ends."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 1, 0))
    if file.read() in (b"", b"\n"):
        return size
    file.seek(0)
    return file.read().rfind(b"\n") + 1


def whole_lines(path: Path) -> tuple[list[bytes], bool]:
    """Lines of a file, none where there is no file; and whether another one is incomplete."""
    try:
        *lines, rest = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return [], False
    return lines, bool(rest)


def _sync_folder(path: Path) -> None:
    """Have the names in a folder on the disk, too."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def lock_folder(folder: Path) -> int | None:
    """A file descriptor that keeps other processes from locking a folder until it is closed.

    None: another process has it.
    """
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            return None
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
