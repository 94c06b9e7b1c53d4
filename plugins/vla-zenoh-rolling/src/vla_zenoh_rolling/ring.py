"""A ring of recordings on disk: short files, of which the oldest are deleted."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.reader import SEGMENT, segments_of

PART = ".part"
FACTS = "saved.json"


class Segment(NamedTuple):
    """A file of the ring, with the number of samples that are missing in it."""

    path: Path
    seconds: float
    size_bytes: int
    missing: int = 0


class RingLimits(NamedTuple):
    """Sizes of the record.

    Args:
        keep_s: how much is kept, at least, if `max_bytes` allows.
        max_bytes: of all files, but for the one that is being written.
        segment_s: longest of one file.
        after_s: a saved record goes on for this long after what it was saved for.
    """

    keep_s: float = 600.0
    max_bytes: int = 2 * 1024**3
    segment_s: float = 30.0
    after_s: float = 3.0


class Ring:
    """The files of a folder, the newest last. What was there before is taken over.

    Raises:
        RecordingError: the folder cannot be used.
    """

    def __init__(self, folder: Path, limits: RingLimits) -> None:
        self._folder, self._limits = folder, limits
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Of an earlier process; how much of its longest time a file covers is not known.
            self.segments = [
                Segment(path, limits.segment_s, path.stat().st_size) for path in segments_of(folder)
            ]
        except OSError as error:
            raise RecordingError(f"{folder} cannot be used: {error.strerror}") from error
        self._next = 1 + max((number_of(each.path) for each in self.segments), default=0)

    @property
    def seconds(self) -> float:
        return sum(each.seconds for each in self.segments)

    @property
    def size_bytes(self) -> int:
        return sum(each.size_bytes for each in self.segments)

    @property
    def missing(self) -> int:
        return sum(each.missing for each in self.segments)

    def next_path(self) -> Path:
        """Of the file to write next."""
        path = self._folder / SEGMENT.format(self._next)
        self._next += 1
        return path

    def add(self, path: Path, seconds: float, missing: int = 0) -> None:
        """Take a finished file into the ring, and delete what is too old or too much."""
        with suppress(OSError):
            self.segments.append(Segment(path, seconds, path.stat().st_size, missing))
        while len(self.segments) > 1 and (
            self.seconds - self.segments[0].seconds >= self._limits.keep_s
            or self.size_bytes > self._limits.max_bytes
        ):
            self.drop_oldest()

    def drop_oldest(self) -> None:
        """Delete the oldest file, if there is one."""
        if self.segments:
            self.segments.pop(0).path.unlink(missing_ok=True)

    def save(self, folder: Path, extra: list[Path], facts: Mapping[str, Any]) -> int:
        """Keep the finished files in a new folder, which is there as a whole or not at all.

        They are linked, so they take no more room until the ring has deleted them.

        Returns:
            Number of files.

        Raises:
            RecordingError: it cannot be written.
        """
        part = folder.with_name(folder.name + PART)
        try:
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir(parents=True)
            for each in self.segments:
                _link(each.path, part / each.path.name)
            for path in extra:
                shutil.copy2(path, part / path.name)
            (part / FACTS).write_text(json.dumps(facts, indent=2) + "\n", "utf-8")
            part.rename(folder)
        except OSError as error:
            shutil.rmtree(part, ignore_errors=True)
            raise RecordingError(f"{folder} cannot be written: {error.strerror}") from error
        return len(self.segments)


def number_of(path: Path) -> int:
    """Of a file of a ring."""
    found = re.search(r"\d+", path.name)
    return int(found[0]) if found else 0


def _link(path: Path, to: Path) -> None:
    try:
        os.link(path, to)
    except OSError:  # a file system without links
        shutil.copy2(path, to)


def delete_oldest_saved(folder: Path, keep: int) -> list[Path]:
    """Delete the oldest automatically saved folders but for `keep`; returns which."""
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        with suppress(OSError, ValueError):
            if json.loads((path / FACTS).read_text("utf-8")).get("asked") is False:
                found.append(path)
    gone = found[: max(len(found) - keep, 0)]
    for path in gone:
        shutil.rmtree(path, ignore_errors=True)
    return gone
