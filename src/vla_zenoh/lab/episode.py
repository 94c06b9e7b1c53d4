"""An episode: one prompt that the arm follows until it ends."""

from __future__ import annotations


class Interrupted(Exception):
    """Ctrl-C: brake, then write what there is."""
