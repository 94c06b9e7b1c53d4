"""What tests of the view share: a Rerun file as rows by entity."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


class Shown:
    """What stands in a Rerun file.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._rows: defaultdict[str, list[tuple[int | None, dict[str, Any]]]] = defaultdict(list)
        for chunk in RrdReader(str(path)).stream():
            batch = chunk.to_record_batch()
            timed = "time" in batch.schema.names
            stamps = batch.column("time").cast("int64").to_pylist() if timed else []
            columns = [name for name in batch.schema.names if ":" in name]
            for index, row in enumerate(batch.select(columns).to_pylist()):
                at_ns = stamps[index] if timed else None
                values = {name: value for name, value in row.items() if value is not None}
                self._rows[chunk.entity_path.removeprefix("/")].append((at_ns, values))

    @property
    def paths(self) -> set[str]:
        """Entities that have anything."""
        return set(self._rows)

    def rows(self, path: str) -> list[dict[str, Any]]:
        """All rows of an entity that are of a time."""
        return [values for at_ns, values in self._rows[path] if at_ns is not None]

    def static(self, path: str) -> dict[str, Any]:
        """What holds at all times."""
        return {k: v for at_ns, row in self._rows[path] if at_ns is None for k, v in row.items()}

    def values(self, path: str, component: str) -> list[Any]:
        """One component over time."""
        return [row[component] for row in self.rows(path) if component in row]

    def texts(self, path: str) -> list[str]:
        """What was written there over time."""
        return [
            text
            for row in self.rows(path)
            for name in ("TextDocument:text", "TextLog:text")
            for text in row.get(name, [])
        ]

    def scalars(self, path: str) -> list[float]:
        """A figure over time."""
        return [value for row in self.values(path, "Scalars:scalars") for value in row]

    def span_ns(self, path: str) -> tuple[int, int]:
        """First and last time of an entity."""
        stamps = [at_ns for at_ns, _ in self._rows[path] if at_ns is not None]
        return min(stamps), max(stamps)
