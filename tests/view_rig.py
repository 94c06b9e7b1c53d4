"""What tests of the view share: a Rerun file as rows by entity."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


class Shown:
    """What stands in a Rerun file; read when it is asked for, because meshes are large.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._batches: defaultdict[str, list[Any]] = defaultdict(list)
        for chunk in RrdReader(str(path)).stream():
            self._batches[chunk.entity_path.removeprefix("/")].append(chunk.to_record_batch())

    @property
    def paths(self) -> set[str]:
        """Entities that have anything."""
        return set(self._batches)

    def static(self, path: str) -> set[str]:
        """Components that hold at all times."""
        every = (batch for batch in self._batches[path] if "time" not in batch.schema.names)
        return {name for batch in every for name in batch.schema.names if ":" in name}

    def held(self, path: str, component: str) -> list[Any]:
        """A component that holds at all times."""
        every = (batch for batch in self._batches[path] if "time" not in batch.schema.names)
        return [
            value
            for batch in every
            if component in batch.schema.names
            for value in batch.column(component).to_pylist()
        ]

    def stamps_ns(self, path: str) -> list[int]:
        """Times of an entity's rows."""
        return [
            stamp
            for batch in self._batches[path]
            if "time" in batch.schema.names
            for stamp in batch.column("time").cast("int64").to_pylist()
        ]

    def values(self, path: str, component: str) -> list[Any]:
        """One component over time."""
        return [value for value in self._over_time(path, component) if value is not None]

    def _over_time(self, path: str, component: str) -> Iterator[Any]:
        for batch in self._batches[path]:
            if {"time", component} <= set(batch.schema.names):
                yield from batch.column(component).to_pylist()

    def texts(self, path: str) -> list[str]:
        """What was written there over time."""
        names = ("TextDocument:text", "TextLog:text")
        return [text for name in names for row in self.values(path, name) for text in row]

    def scalars(self, path: str) -> list[float]:
        """A figure over time."""
        return [value for row in self.values(path, "Scalars:scalars") for value in row]
