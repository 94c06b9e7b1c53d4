"""Lines of an audit log, each with the hash of the one before it. Pure.

A line is JSON with sorted keys: ``number``, ``wall_ns``, ``what``, ``facts``, ``before`` (hash of
the line before, zeros for the first) and ``hash``: SHA-256 of the same JSON without it. So a line
that was edited, removed, inserted or moved shows; one that was removed at the very end does not,
unless its hash is known from elsewhere (the status of the node publishes the newest).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

FIRST = "0" * 64
"""`before` of the first line."""
MAX_FAULTS = 100


class Link(NamedTuple):
    """The end of a chain.

    Args:
        number: of the next line.
        head: hash of the last line.
    """

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
        lines: number of them.
        first: number of the first line; above 0 older ones are not there any more.
        head: hash of the last line.
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
