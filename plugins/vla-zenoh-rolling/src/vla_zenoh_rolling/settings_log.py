"""The log of a rolling record: who put which setting, and what came of it, one line each.

A line is JSON: ``at`` (local time), ``wall_ns``, ``what`` and what else is known.
"""

from __future__ import annotations

import json
import os
from datetime import datetime
from pathlib import Path
from typing import Any

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.durable import append_lines, lock_folder, whole_lines, writing

LOG, BEFORE = "settings.jsonl", "settings-before.jsonl"
"""The newest lines, and those that no longer fit into that file."""
FILE_BYTES = 8 * 1024 * 1024
MAX_WAITING = 10_000
"""Lines that wait for a full disk; more are counted and lost."""


class SettingsLog:
    """Appends lines to a file of a folder; a last line that is incomplete is cut off.

    Args:
        file_bytes: size at which another file begins; there are two.

    Raises:
        RecordingError: the folder cannot be used, or another process writes into it.
    """

    def __init__(self, folder: Path, *, file_bytes: int = FILE_BYTES) -> None:
        self._folder, self._path, self._file_bytes = folder, folder / LOG, file_bytes
        self._waiting: list[str] = []
        self.lost = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock_folder(folder)
            if self._lock is None:
                raise RecordingError(
                    f"another rolling record writes into {folder}: end it, or give this one "
                    "another --folder (`up`: another --log-dir, or --no-record)"
                )
        except OSError as error:
            raise RecordingError(f"{folder} cannot be used: {error.strerror}") from error
        last = entries_of(folder)[-1:]
        self.last_what = last[0]["what"] if last else ""
        """Of the last line that was there before; empty: there was none."""

    def add(self, what: str, wall_ns: int, **facts: Any) -> None:
        """Add a line; it is on disk after the next `write`."""
        if len(self._waiting) >= MAX_WAITING:
            self.lost += 1
            return
        at = datetime.fromtimestamp(wall_ns / 1e9).isoformat(" ", "milliseconds")
        self._waiting.append(json.dumps({"at": at, "wall_ns": wall_ns, "what": what, **facts}))

    def write(self) -> None:
        """Append what was added since; it is on the disk, not in a cache, when this returns.

        Raises:
            RecordingError: the disk is full or broken. The lines stay, for the next call.
        """
        if not self._waiting:
            return
        with writing(self._path, RecordingError):
            size = self._path.stat().st_size if self._path.exists() else 0
            if size and size + sum(len(line) + 1 for line in self._waiting) > self._file_bytes:
                self._path.replace(self._folder / BEFORE)
            append_lines(self._path, self._waiting)
        self._waiting.clear()

    def close(self) -> None:
        """Leave the folder to others."""
        if self._lock is not None:
            os.close(self._lock)


def logs_of(folder: Path) -> list[Path]:
    """Files of the log of a folder, oldest first."""
    return [path for path in (folder / BEFORE, folder / LOG) if path.exists()]


def entries_of(folder: Path) -> list[dict[str, Any]]:
    """The complete lines of the log of a folder, oldest first."""
    found = []
    for path in logs_of(folder):
        for line in whole_lines(path)[0]:
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            if isinstance(entry, dict) and "what" in entry:
                found.append(entry)
    return found
