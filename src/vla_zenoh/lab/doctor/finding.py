"""What a check of the host says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class HostFinding:
    """The result of one check.

    Args:
        name: what was looked at.
        level: ``ok``; ``warn``: works, but worse than it could; ``fail``: something will not work.
        found: what is there.
        advice: the package, command or setting that helps; empty when all is well.
    """

    name: str
    level: Level
    found: str
    advice: str = ""
