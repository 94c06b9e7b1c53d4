"""Finding of a check of the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class HostFinding:
    """Result of one check.

    Args:
        name: of the check.
        level: ``ok``; ``warn``: works, with limits; ``fail``: something will not work.
        found: what the check found.
        advice: the package, command or setting that helps; empty with ``ok``.
    """

    name: str
    level: Level
    found: str
    advice: str = ""
