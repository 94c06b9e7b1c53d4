"""The worker's module, from the folder above, for the scripts of this one."""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(FOLDER))

from model import (  # noqa: E402
    FRONT,
    GRAPH,
    HORIZON,
    MANIFEST,
    MAX_PIECES,
    WORDS,
    WRIST,
    Brick,
    Hand,
    Question,
    Waypoints,
    tokens_of,
)

__all__ = [
    "FOLDER",
    "FRONT",
    "GRAPH",
    "HORIZON",
    "MANIFEST",
    "MAX_PIECES",
    "WORDS",
    "WRIST",
    "Brick",
    "Hand",
    "Question",
    "Waypoints",
    "tokens_of",
]
