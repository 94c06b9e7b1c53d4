"""An audit log on disk: lines that are chained by hash, written at once, bounded in size.

A line is JSON with sorted keys: ``number``, ``wall_ns``, ``what``, ``facts``, ``before`` (hash of
the line before) and ``hash``, SHA-256 of the same JSON without it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.durable import lock_folder

FIRST = "0" * 64
"""`before` of the first line."""
MAX_FAULTS = 100


class Link(NamedTuple):
    """The end of a chain."""

    number: int = 0
    head: str = FIRST


def _json(fields: Mapping[str, Any]) -> str:
    return json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _hash(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(_json(fields).encode()).hexdigest()


def line_after(link: Link, wall_ns: int, what: str, facts: Mapping[str, Any]) -> tuple[str, Link]:
    """The line that follows `link`, without its line feed, and the end of the chain then."""
    fields: dict[str, Any] = {
        "number": link.number,
        "wall_ns": wall_ns,
        "what": what,
        "facts": dict(facts),
        "before": link.head,
    }
    head = _hash(fields)
    return _json({**fields, "hash": head}), Link(link.number + 1, head)


def fields_of(line: str) -> dict[str, Any] | None:
    """The fields of a line; None: it is none."""
    try:
        fields = json.loads(line)
    except (ValueError, RecursionError):
        return None
    names = {"number", "wall_ns", "what", "facts", "before", "hash"}
    if not isinstance(fields, dict) or fields.keys() != names:
        return None
    whole = type(fields["number"]) is int and type(fields["wall_ns"]) is int
    texts = all(isinstance(fields[name], str) for name in ("what", "before", "hash"))
    return fields if whole and texts and isinstance(fields["facts"], dict) else None


@dataclass(slots=True)
class Verification:
    """What the lines of an audit log show.

    Args:
        first: number of the first line; above 0 older ones are not there any more.
        faults: what does not fit, by line; empty: nothing was edited, removed or inserted.
        gaps: times in which nothing was recorded, or not everything, as the log itself says.
        entries: the lines that could be read, oldest first.
    """

    lines: int = 0
    first: int = 0
    head: str = FIRST
    faults: list[str] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)
    entries: list[dict[str, Any]] = field(default_factory=list)

    def has(self, head: str) -> bool:
        """Whether a line with this hash is there."""
        return any(entry["hash"] == head for entry in self.entries)


GAPS = ("after_gap", "lost", "dropped", "disk")
"""What a line is called that says that something is missing."""


def verify(lines: Iterable[str]) -> Verification:
    """Check the lines of an audit log, oldest first."""
    out = Verification()
    before: dict[str, Any] | None = None
    for at, line in enumerate(lines, 1):
        out.lines = at
        fields = fields_of(line)
        if fields is None:
            _fault(out, f"line {at} is no line of an audit log")
            before = None
            continue
        without = {name: value for name, value in fields.items() if name != "hash"}
        if _hash(without) != fields["hash"] or _json(fields) != line:
            _fault(out, f"line {at} (number {fields['number']}) was edited")
        if before is None and at == 1:
            out.first = fields["number"]
            if out.first == 0 and fields["before"] != FIRST:
                _fault(out, "line 1 is not the beginning of a log")
        elif before is not None:
            missing = fields["number"] - before["number"] - 1
            if missing:
                kind = f"{missing} removed" if missing > 0 else "moved, or inserted"
                _fault(out, f"before line {at} (number {fields['number']}): {kind}")
            elif fields["before"] != before["hash"]:
                _fault(out, f"line {at} (number {fields['number']}) does not follow the one before")
        if fields["what"] in GAPS:
            out.gaps.append(f"number {fields['number']}: {fields['what']} {_json(fields['facts'])}")
        out.entries.append(fields)
        out.head = fields["hash"]
        before = fields
    return out


def _fault(out: Verification, why: str) -> None:
    if len(out.faults) < MAX_FAULTS:
        out.faults.append(why)


PATTERN = "audit-*.jsonl"
FILE_BYTES = 8 * 1024 * 1024
KEPT_FILES = 8
MAX_PENDING = 10_000
"""Lines that wait for a full disk; more are counted and lost."""


class AuditLog:
    """Appends lines to the newest file of a folder.

    A last line that a power cut left incomplete is cut off, and `cut_bytes` says so.

    Args:
        file_bytes: size at which another file begins; the last `KEPT_FILES` are kept.

    Raises:
        RecordingError: the folder cannot be used.
    """

    def __init__(self, folder: Path, *, file_bytes: int = FILE_BYTES) -> None:
        self._folder, self._file_bytes = folder, file_bytes
        self.link, self.cut_bytes, self.lost = Link(), 0, 0
        self.last_what = ""
        """Of the last line that was there before; empty: there was none."""
        self._pending: list[str] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = lock_folder(folder)
            if lock is None:  # two logs in one folder would be no chain
                raise RecordingError(
                    f"another rolling record writes into {folder}: end it, or give this one "
                    "another --folder (`up`: another --log-dir, or --no-record)"
                )
            self._lock = lock
            files = _files(folder)
            self._path = files[-1] if files else self._named(0)
            self._resume()
        except OSError as error:
            raise RecordingError(f"{folder} cannot be used: {error.strerror}") from error

    def _named(self, first: int) -> Path:
        return self._folder / f"audit-{first:012d}.jsonl"

    def _resume(self) -> None:
        self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        self._size = os.fstat(self._fd).st_size
        data = self._path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            self.cut_bytes = len(data) - len(whole)
            self._size = len(whole)
            os.ftruncate(self._fd, self._size)
        # A file that was begun, with nothing in it yet, goes on from the one before.
        for path in reversed(_files(self._folder)):
            lines = path.read_text("utf-8", "replace").splitlines()
            known = next((fields for line in reversed(lines) if (fields := fields_of(line))), None)
            if known is not None:
                self.link = Link(known["number"] + 1, known["hash"])
                self.last_what = known["what"]
                return

    def add(self, what: str, wall_ns: int, **facts: Any) -> None:
        """Chain a line; it is on disk after the next `write`."""
        if len(self._pending) >= MAX_PENDING:
            self.lost += 1
            return
        line, self.link = line_after(self.link, wall_ns, what, facts)
        self._pending.append(line)

    def write(self) -> None:
        """Append what was added since; it is on the disk, not in a cache, when this returns.

        Raises:
            RecordingError: the disk is full or broken. The lines stay, for the next call.
        """
        if not self._pending:
            return
        data = "".join(f"{line}\n" for line in self._pending).encode()
        try:
            if self._size + len(data) > self._file_bytes and self._size:
                self._turn_over()
            written = 0
            while written < len(data):
                written += os.write(self._fd, data[written:])
            os.fsync(self._fd)
        except OSError as error:
            os.ftruncate(self._fd, self._size)
            raise RecordingError(f"{self._path}: {error.strerror}") from error
        self._size += len(data)
        self._pending.clear()

    def _turn_over(self) -> None:
        path = self._named(self.link.number - len(self._pending))
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        os.close(self._fd)
        self._fd, self._path, self._size = fd, path, 0
        for old in _files(self._folder)[:-KEPT_FILES]:
            old.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, and leave the folder to others."""
        os.close(self._fd)
        os.close(self._lock)


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob(PATTERN))


def lines_of(folder: Path) -> Iterator[str]:
    """Lines of all files of a log, oldest first; the last one may be incomplete.

    Raises:
        RecordingError: there is none.
    """
    files = _files(folder)
    if not files:
        raise RecordingError(
            f"{folder} has no audit log ({PATTERN}); `vla-zenoh up` says where its own is"
        )
    for path in files:
        try:
            text = path.read_text("utf-8", "replace")
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
        yield from text.removesuffix("\n").split("\n") if text else ()


def verify_folder(folder: Path) -> Verification:
    """Check the audit log of a folder. Raises RecordingError: there is none."""
    return verify(lines_of(folder))
