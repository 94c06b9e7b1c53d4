"""What tests of the view share: a Rerun file as rows by entity."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
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
            for row in batch.to_pylist():
                stamp = row.pop("time", None)
                row.pop("rerun.controls.RowId", None)
                at_ns = None if stamp is None else int(np.datetime64(stamp, "ns").astype("int64"))
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
